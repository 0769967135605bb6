"""GPS against the map: a receiver that is wrong is found, one that is right is left in peace."""

import math
from functools import partial

import numpy as np
import pytest
from fakes import FakeClock, FakeLink, make_output, make_receiver, make_vehicle
from simulated_flight import GPS_SD_M, HOME, SimFlight, make_match, norms

from edgevpr.core.geodesy import offset_position
from edgevpr.core.reasons import ReasonCode, read_reason
from edgevpr.core.types import FRAME_TIME_SD_S, Position
from edgevpr.runtime.flight.flightlog import FlightLog, read_log
from edgevpr.runtime.flight.gpswatch import GpsWatch
from edgevpr.runtime.flight.navigator import Advice, Navigator
from edgevpr.runtime.flight.notifier import Notifier

pytestmark = pytest.mark.slow

MAP_SD_M = 5.0
DRIFT_DIRECTION = np.array([0.6, 0.8])


class GpsFlight(SimFlight):
    """A flight whose matches go to the autopilot and to the watch over GPS, as in the loop; `news`: its log lines."""

    def __init__(self, flight_log, clock, **how):
        super().__init__(Navigator(MAP_SD_M, 1.0), **{"fix_sd_m": 2.0, "late_s": 0.0} | how)
        self.clock = clock
        self.link = FakeLink(self.clock)
        self.autopilot = make_output(self.link, self.navigator, self.clock, flight_log)
        self.log, self.drift_m_s, self.reports = flight_log.path, 0.0, []
        self.watch = GpsWatch(MAP_SD_M, Notifier(flight_log, self.link), self.autopilot)

    def advise(self, event):
        self.clock.now_s = self.t_s
        event = self.autopilot.report_match(event, 0.0)
        self.watch.update(event)
        self.reports.append(event.fix)
        return Advice(None, event.fix.why)

    def fly(self, seconds):
        for _ in range(round(seconds)):
            self.gps_off_m = self.gps_off_m + self.drift_m_s * DRIFT_DIRECTION
            super().fly(1)
        return self

    @property
    def news(self):
        return [line for line in read_log(self.log) if line["kind"] == "gps"]

    def distances(self):
        return [each.value for each in self.link.sent if getattr(each, "name", "") == "vpr_gps_m"]


@pytest.fixture
def make_air(tmp_path):
    """Makes one flight."""
    clock = FakeClock(0.0)
    with FlightLog(tmp_path / "log", clock=clock) as flight_log:
        yield partial(GpsFlight, flight_log, clock)


def fly_until_alarm(air, off_m=30.0):
    """Fly until the alarm; return the seconds from when GPS was so far off."""
    is_off_s = None if math.hypot(*air.gps_off_m) < off_m else air.t_s
    for _ in range(120):
        air.fly(1)
        if is_off_s is None and math.hypot(*air.gps_off_m) >= off_m:
            is_off_s = air.t_s
        if air.news:
            return air.news[0]["t_mono_s"] - (air.t_s if is_off_s is None else is_off_s)
    raise AssertionError("no alarm")


def start_glitch(air, drift_m_s):
    if drift_m_s is None:
        air.gps_off_m = np.array([100.0, 0.0])
    else:
        air.drift_m_s = drift_m_s


GLITCHES = pytest.mark.parametrize("drift_m_s", [None, 1.0, 2.0, 5.0], ids=["jump", "1 m/s", "2 m/s", "5 m/s"])


@GLITCHES
@pytest.mark.parametrize("fix_sd_m", [1.0, 3.0])
def test_gps_watch_detects_jumps_and_drift_within_fifteen_seconds_of_thirty_metres(make_air, drift_m_s, fix_sd_m):
    air = make_air(fix_sd_m=fix_sd_m).fly(30)
    assert air.news == []
    start_glitch(air, drift_m_s)
    assert fly_until_alarm(air) < 15
    air.fly(60)
    news = air.news[0]
    assert all(line["is_wrong"] for line in air.news)
    assert news["note"]["code"] == "GPS_DIFFERS"
    assert news["note"]["parameters"]["distance_m"] == pytest.approx(news["distance_m"], abs=0.06)
    reported = [f"edgevpr: {read_reason(line['note'])}" for line in air.news]
    assert [text for _, text in air.link.texts() if "GPS" in text] == reported
    assert len(air.distances()) == len(air.events)
    assert air.distances()[-1] == pytest.approx(math.hypot(*air.gps_off_m), abs=15)


@pytest.mark.parametrize(("t_sd_s", "is_wrong"), [(FRAME_TIME_SD_S, True), (1.0, False)])
def test_gps_watch_allows_for_the_time_of_a_frame(make_air, t_sd_s, is_wrong):
    """At 15 m/s a second is 15 m: then 30 m prove nothing."""
    air = make_air(t_sd_s=t_sd_s).fly(20)
    air.gps_off_m = np.array([30.0, 0.0])
    assert air.fly(40).watch.is_wrong is is_wrong


@pytest.mark.parametrize("agrees_s", [0, 30])
def test_map_that_never_agreed_with_gps_is_not_used_after_gps_loss(make_air, agrees_s):
    """A map that is 300 m off contradicts GPS from the first match on, a receiver that is led away only later."""
    air = make_air().fly(agrees_s)
    air.gps_off_m = np.array([300.0, 0.0])
    air.fly(30)
    assert air.watch.is_wrong
    assert air.navigator.trusts_gps() is (agrees_s == 0)
    air.lose_gps()
    assert any(fix.sent for fix in air.fly(20).reports[-20:]) is (agrees_s > 0)


@GLITCHES
def test_navigation_trusts_fixes_over_wrong_gps_but_sends_none_while_the_autopilot_uses_gps(make_air, drift_m_s):
    air = make_air().fly(60)
    assert air.navigator.has_gps
    start_glitch(air, drift_m_s)
    fly_until_alarm(air)
    air.fly(60)
    assert not air.navigator.has_gps
    off_m = []
    for _ in range(20):
        air.fly(1)
        here = air.navigator._navigation.estimate_state(air.t_s).position
        off_m.append(air.measure_error(here.lat_deg, here.lon_deg))
    assert norms(off_m).max() < 8, "where the autopilot is 60 m off and more"
    assert air.link.stats().fixes_sent == 0
    assert {report.why.code for report in air.reports[-20:]} == {ReasonCode.HAS_WRONG_GPS}


@pytest.mark.parametrize("fix_sd_m", [1.0, 3.0, 8.0])
def test_gps_watch_gives_no_false_alarm_in_thirty_minutes_of_noise(fix_sd_m):
    """Five flights, whose maps are off by what the configuration says."""
    for seed in range(5):
        rng, watch = np.random.default_rng(seed), GpsWatch(MAP_SD_M, Notifier(FlightLog(None), None), None)
        map_off_m = MAP_SD_M * np.array([math.cos(seed), math.sin(seed)])
        at_m, wander_m, velocity = np.zeros(2), np.zeros(2), (12.0, 5.0)
        for t_s in map(float, range(1800)):
            at_m = at_m + velocity
            wander_m = 59 / 60 * wander_m + rng.normal(0, 2 * math.sqrt(2 / 60), 2)
            off_m = map_off_m + rng.normal(0, fix_sd_m, 2)
            if rng.random() < 0.01:
                turn = rng.uniform(0, 2 * math.pi)
                off_m = 100 * np.array([math.cos(turn), math.sin(turn)])
            gps = offset_position(*HOME, *(at_m + wander_m))
            known = {"gps": make_receiver(gps, GPS_SD_M, t_s), "velocity_m_s": velocity, "height_m": 100.0}
            seen = Position(*offset_position(*HOME, *(at_m + off_m)))
            watch.update(make_match(seen, t_s, make_vehicle(*gps, t_s, **known), fix_sd_m, (int(t_s),)))
            assert not watch.is_wrong


@pytest.mark.parametrize("seed", range(2))
def test_gps_watch_detects_slow_drift_within_fifteen_seconds_of_its_start(make_air, seed):
    """With matches as good as those of a refined map: what they and the receiver have in common cancels out."""
    air = make_air(fix_sd_m=0.7, seed=seed).fly(60)
    air.drift_m_s = 1.0
    assert fly_until_alarm(air, 0.0) <= 15
