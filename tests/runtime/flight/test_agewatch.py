"""Hidden delays of pictures: found, taken out and claimed by the aircraft's own motion."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fakes import make_output
from simulated_flight import HOME, PICTURE, STEP_S, SimFlight, make_match

from edgevpr.core.geodesy import offset_position
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import FRAME_TIME_SD_S, Frame, Position
from edgevpr.frames.age import HIDDEN_DELAY_SD_S
from edgevpr.frames.level import LevelledImage
from edgevpr.runtime.flight.agewatch import AgeWatch, Delay
from edgevpr.runtime.flight.flightlog import FlightLog, read_log
from edgevpr.runtime.flight.navigator import Advice, Navigator

pytestmark = pytest.mark.slow

CIRCLE = {"turn_s": 20.0}
TIGHT_CIRCLE = {"turn_s": 7.5}
STRAIGHT = {"turn_s": math.inf}
HOVER = {"turn_s": math.inf, "speed_m_s": 0.0}


class LateCameraFlight(SimFlight):
    """A flight whose pictures are `hidden_s` older than they claim, in circles of 2 pi `turn_s` seconds. GPS is lost
    after 30 s, as a wind comes up. `refused`: times of matches that were not used; `off_s`: by how much the last
    frame's time is wrong, and `t_sd_s` what it claims; `errors_sd`: errors of fixes over what they claim."""

    def __init__(self, *, turn_s, hidden_s=0.0, delay_sd_s=HIDDEN_DELAY_SD_S, speed_m_s=12.0, **how):
        self.turn_s, self.hidden_s, self.delay_sd_s = turn_s, hidden_s, delay_sd_s
        self.refused, self.errors_sd = [], []
        usual = {"wind": (6.0, 0.0), "gusts": 0.3, "fix_sd_m": 1.5}
        super().__init__(Navigator(1.0, 1.0), speed_m_s=speed_m_s, **(usual | how))
        self.fly(30).lose_gps()
        self.fly(40)

    def heading_deg(self, t_s):
        return math.degrees(t_s / self.turn_s) % 360

    def velocity(self, t_s):
        return self.speed_m_s * np.array([math.sin(t_s / self.turn_s), math.cos(t_s / self.turn_s)])

    def match(self, step, vehicle):
        true_step = max(0, step - round(self.hidden_s / STEP_S))
        age = self.navigator.age
        claimed = Frame(image=PICTURE, name="", t_mono_s=step * STEP_S, delay_sd_s=self.delay_sd_s)
        frame = age.correct(claimed)
        seen_m = self.way[true_step] + self.rng.normal(0, self.noise_sd_m, 2)
        where = Position(*offset_position(*HOME, *seen_m))
        event = make_match(where, frame.t_mono_s, vehicle, self.said_sd_m, self.places(true_step))
        picture = LevelledImage(PICTURE, None, replace(event.view, up_deg=self.heading_deg(frame.t_mono_s)))
        heading_deg = self.heading_deg(true_step * STEP_S) + self.rng.normal(0, 1.0)
        event = replace(event, frame=frame, picture=picture, located=replace(event.located, heading_deg=heading_deg))
        self.off_s, self.t_sd_s = frame.t_mono_s - true_step * STEP_S, frame.t_sd_s
        if not self.navigator.is_out_of_reach(event):
            age.judge(event)
        if age.is_unknown:
            self.refused.append(self.t_s)
            return Advice(None, Reason(ReasonCode.AGE_UNKNOWN))
        advice = self.advise(event)
        self.advices.append((self.t_s, advice))
        if advice.fix:
            error_m = math.hypot(*self.measure_error(advice.fix.lat_deg, advice.fix.lon_deg, advice.fix.t_frame_s))
            self.errors_sd.append(error_m / advice.fix.accuracy_m)
            self.apply_fix(advice.fix)
        return advice

    def _report(self, velocity):
        hear = self.navigator.handle_vehicle
        self.navigator.handle_vehicle = lambda vehicle: hear(replace(vehicle, heading_deg=self.heading_deg(self.t_s)))
        super()._report(velocity)
        self.navigator.handle_vehicle = hear


@pytest.mark.parametrize(("path", "hidden_s"), [(CIRCLE, 0.5), (TIGHT_CIRCLE, 0.0), (STRAIGHT, 0.5), (HOVER, 0.0)])
def test_pictures_of_a_usual_delay_are_used_and_claims_are_met(path, hidden_s):
    air = LateCameraFlight(hidden_s=hidden_s, **path).fly(60)
    assert air.refused == []
    assert abs(air.off_s) < 3 * air.t_sd_s
    assert len(air.errors_sd) > 5
    assert np.mean(np.array(air.errors_sd) > 3) < 0.05


@pytest.mark.parametrize("path", [CIRCLE, HOVER])
def test_age_watch_keeps_times_and_uncertainty_of_a_local_camera(path):
    air = LateCameraFlight(delay_sd_s=FRAME_TIME_SD_S, **path).fly(60)
    assert air.refused == []
    assert air.off_s == pytest.approx(0.0, abs=1e-9)
    assert air.t_sd_s < 0.1


@pytest.mark.parametrize(("hidden_s", "within_s"), [(1.0, 0.4), (3.0, 0.3)])
def test_age_watch_finds_a_delay_in_turns_and_corrects_it(hidden_s, within_s):
    air = LateCameraFlight(hidden_s=hidden_s, **TIGHT_CIRCLE).fly(60)
    assert abs(air.off_s) < within_s
    assert abs(air.off_s) < 3 * air.t_sd_s
    assert np.mean(np.array(air.errors_sd[-20:]) > 3) <= 0.05


@pytest.mark.parametrize(
    ("path", "delay_sd_s"),
    [(CIRCLE, FRAME_TIME_SD_S), (TIGHT_CIRCLE, HIDDEN_DELAY_SD_S), (STRAIGHT, HIDDEN_DELAY_SD_S)],
)
def test_age_watch_refuses_suddenly_late_images_until_the_delay_is_as_before(path, delay_sd_s):
    air = LateCameraFlight(delay_sd_s=delay_sd_s, **path)
    air.hidden_s, from_s = 3.0, air.t_s
    air.fly(1)
    air.errors_sd.clear()
    air.between.clear()
    air.fly(14)
    assert len(air.refused) == 15, "all of them"
    assert air.between == [], "and nothing between them"
    air.hidden_s = 0.0
    air.fly(30)
    assert max(air.refused) < from_s + 20
    assert max(air.errors_sd, default=0.0) < 3


def test_match_out_of_reach_is_not_taken_for_a_late_one(monkeypatch):
    air = LateCameraFlight(**CIRCLE)
    monkeypatch.setitem(globals(), "HOME", (HOME[0] + 0.005, HOME[1]))
    air.fly(1)
    monkeypatch.undo()
    air.fly(10)
    assert air.refused == [], "if images were of unknown age, odometry would end, and off the map the position too"


@pytest.mark.parametrize("path", [CIRCLE, TIGHT_CIRCLE, STRAIGHT])
def test_age_watch_treats_a_frozen_image_as_of_unknown_age(path):
    air = LateCameraFlight(**path)
    for _ in range(10):
        air.fly(1)
        air.hidden_s += 1.0
    assert len(air.refused) >= 8, "a delay of one second may be usual"


def test_check_age_reports_once_and_skips_the_match(tmp_path, clock, link):
    log = FlightLog(tmp_path / "log", clock=clock)
    ages = [(False, 0.0), (True, 0.0), (True, 0.0), (False, 0.6)]
    navigator, events, summaries = Navigator(1.0, 1.0), [], []
    autopilot = make_output(link, navigator, clock, log)
    for is_unknown, delay_s in ages:
        navigator.age = SimpleNamespace(judge=lambda _: None, is_unknown=is_unknown, delay_s=delay_s)
        event = make_match(Position(*HOME), clock(), None, 3.0, (1,))
        events.append(autopilot.check_age(event))
        summaries.append(autopilot.age_summary)
    assert [event.accepted for event in events] == [True, False, False, True]
    assert events[1].reason.code is ReasonCode.AGE_UNKNOWN
    assert events[1].located is None
    assert [severity for severity, _ in link.texts()] == [4, 6, 6]
    assert len([line for line in read_log(tmp_path / "log") if line["kind"] == "age"]) == 3
    assert summaries[0] is None
    assert summaries[1] == summaries[2] != summaries[3]


def test_correct_claims_a_negative_delay_but_does_not_subtract_it():
    """A camera that looks ahead of straight down looks as if its images were newer than their times."""
    age, frame = AgeWatch(), Frame(image=PICTURE, name="", t_mono_s=1000.0, delay_sd_s=HIDDEN_DELAY_SD_S)
    age._delay = Delay(-0.3, 0.05)
    assert age.correct(frame).t_mono_s == 1000.0
    assert age.correct(frame).t_sd_s > 0.3
    age._delay = Delay(0.3, 0.05)
    assert age.correct(frame).t_mono_s == pytest.approx(999.7)
