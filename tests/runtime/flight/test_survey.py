"""The survey: where a map lies beside GPS, how large it is, and where the camera looks, by the matches of a flight."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from fakes import FakeClock, FakeLink, make_receiver, make_vehicle
from simulated_flight import HOME, make_match

from edgevpr.core.config import load_config
from edgevpr.core.geodesy import move_position, offset_m, offset_position, picture_axes
from edgevpr.core.types import Position
from edgevpr.frames.level import STRAIGHT_DOWN, View
from edgevpr.runtime.flight.flightlog import FlightLog, read_log
from edgevpr.runtime.flight.gpswatch import GpsWatch
from edgevpr.runtime.flight.notifier import Notifier
from edgevpr.runtime.flight.survey import MapSurvey
from edgevpr.runtime.flight.watching import SurveyReporter
from edgevpr.runtime.recognise.levelling import read_mount

OFF_M = np.array([5.0, -3.0])
SCALE = 0.01
AHEAD_DEG = 9.0
RIGHT_DEG = -3.0
HEIGHT_M = 100.0
SPEED_M_S = 15.0
FIX_SD_M = 2.0
GPS_SD_M = 1.0
GPS_TAU_S = 60.0
VIEW = View(up_deg=0.0, footprint_m=130.0, nadir_offset=(0.0, 0.0))


def fly_circle(t_s):
    """Position (2,) and heading in a circle of 300 m."""
    turn = t_s * SPEED_M_S / 300
    return 300 * np.array([1 - math.cos(turn), math.sin(turn)]), math.degrees(turn)


def fly_eights(t_s):
    """The like in two circles beside each other, the one to the right and the other to the left."""
    round_s = 2 * math.pi * 300 / SPEED_M_S
    at_m, heading_deg = fly_circle(t_s % round_s)
    side = 1 if t_s % (2 * round_s) < round_s else -1
    return at_m * (side, 1), side * heading_deg


def fly_lanes(t_s):
    """The like over lanes of 600 m, side by side, without the turns between them."""
    lane, share = divmod(t_s * SPEED_M_S / 600, 1)
    is_back = lane % 2
    return np.array([60 * lane, 600 * (1 - share if is_back else share)]), 180.0 * is_back


def fly_line(t_s):
    return np.array([0.0, SPEED_M_S * t_s]), 0.0


def make_matches(way, seconds, seed=1, wrong=0.0, scale=SCALE, compass_deg=0.0, **said):
    """The matches of a flight, one a second, with a GPS whose error lasts; `wrong` is the share of wrong ones. The
    compass is wrong by `compass_deg`."""
    rng, gps_off_m = np.random.default_rng(seed), np.zeros(2)
    for t_s in map(float, range(seconds)):
        at_m, heading_deg = way(t_s)
        after_m, _ = way(t_s + 0.01)
        gps_off_m = (1 - 1 / GPS_TAU_S) * gps_off_m + rng.normal(0, GPS_SD_M * math.sqrt(2 / GPS_TAU_S), 2)
        mount_m = HEIGHT_M * picture_axes(heading_deg) @ np.tan(np.radians((RIGHT_DEG, AHEAD_DEG)))
        fix_m = at_m + OFF_M + scale * at_m + mount_m + rng.normal(0, FIX_SD_M, 2)
        if rng.random() < wrong:
            fix_m = fix_m + rng.normal(0, 150, 2)
        gps = offset_position(*HOME, *(at_m + gps_off_m))
        velocity = np.clip((after_m - at_m) / 0.01, -SPEED_M_S, SPEED_M_S)
        told_deg = (heading_deg + compass_deg) % 360
        known = {"heading_deg": told_deg, "height_m": HEIGHT_M, "roll_deg": 0.0, "pitch_deg": 0.0}
        known |= {"velocity_m_s": tuple(velocity), "gps": make_receiver(gps, GPS_SD_M, t_s)} | said
        event = make_match(
            Position(*offset_position(*HOME, *fix_m)),
            t_s,
            make_vehicle(*gps, t_s, **known),
            FIX_SD_M,
            (int(t_s),),
            replace(VIEW, up_deg=told_deg),
        )
        yield replace(event, located=replace(event.located, heading_deg=heading_deg % 360))


def run_survey(way, seconds, mount=STRAIGHT_DOWN, **how):
    sightings = MapSurvey(mount, is_level=False)
    for event in make_matches(way, seconds, **how):
        sightings.add_match(event)
    return sightings.compute_result()


def measure_offset_error_m(found):
    """Metres (2,) by which the offset that was found is wrong in the middle of the flight."""
    middle_m = np.array(offset_m(*HOME, found.middle.lat_deg, found.middle.lon_deg))
    return np.array(found.measures["off_m"].value) - OFF_M - SCALE * middle_m


@pytest.mark.parametrize("wrong", [0.0, 0.05])
@pytest.mark.parametrize("way", [fly_eights, fly_lanes])
def test_survey_separates_offset_scale_and_mount(way, wrong):
    for seed in range(4):
        found = run_survey(way, 900, seed=seed, wrong=wrong)
        assert all(each.is_known for each in found.measures.values())
        assert np.abs(measure_offset_error_m(found)).max() < 2.5 * found.measures["off_m"].sd < 1.5
        assert found.measures["scale"].value[0] == pytest.approx(SCALE, abs=2.5 * found.measures["scale"].sd)
        assert found.measures["ahead_deg"].value[0] == pytest.approx(AHEAD_DEG, abs=2 * found.measures["ahead_deg"].sd)
        assert found.measures["right_deg"].value[0] == pytest.approx(RIGHT_DEG, abs=2 * found.measures["right_deg"].sd)


def test_survey_standard_deviations_match_the_errors():
    """Over many flights the errors are as large as is said, neither half nor double of it."""
    found = [run_survey(fly_eights, 600, seed=seed) for seed in range(30)]
    shares = np.array([measure_offset_error_m(each) / each.measures["off_m"].sd for each in found])
    assert 0.5 < np.sqrt(np.mean(shares**2)) < 1.2
    shares = np.array([(each.measures["scale"].value[0] - SCALE) / each.measures["scale"].sd for each in found])
    assert 0.5 < np.sqrt(np.mean(shares**2)) < 1.2


@pytest.mark.parametrize(
    ("way", "bad", "known"), [(fly_circle, 0, ["off_m", "ahead_deg"]), (fly_line, 0.05, ["scale"])]
)
def test_survey_finds_only_what_the_route_separates(way, bad, known):
    found = run_survey(way, 900, wrong=bad)
    assert [name for name, each in found.measures.items() if each.is_known] == known
    assert (found.fields()["off_m"] is None) == (way is fly_line)
    if way is fly_circle:
        assert np.abs(measure_offset_error_m(found)).max() < 2.5 * found.measures["off_m"].sd
        ahead = found.measures["ahead_deg"]
        assert ahead.value[0] == pytest.approx(AHEAD_DEG, abs=2 * ahead.sd)


def test_survey_measures_the_mount_from_image_rotation_with_a_wrong_compass():
    found = run_survey(fly_lanes, 600, compass_deg=90.0)
    assert found.measures["ahead_deg"].value[0] == pytest.approx(AHEAD_DEG, abs=1.0)
    assert found.measures["right_deg"].value[0] == pytest.approx(RIGHT_DEG, abs=1.0)


@pytest.mark.parametrize(
    "said",
    [
        {"has_gps": False},
        {"heading_deg": None},
        {"height_m": None},
        {"roll_deg": None},
        {"velocity_m_s": (math.nan, 0.0)},
        {"gps": None},
        {"gps": make_receiver(HOME, 8.0, 0.0)},
    ],
)
def test_survey_finds_nothing_without_gps_or_attitude(said):
    assert run_survey(fly_lanes, 300, **said) is None


def test_survey_uses_the_receiver_and_not_a_position_derived_from_ours():
    """After a fix of ours the autopilot may repeat it: the receiver itself counts, which is 0.1 s late here."""
    rng = np.random.default_rng(3)
    sightings = MapSurvey(STRAIGHT_DOWN, is_level=False)
    for event in make_matches(fly_lanes, 900):
        vehicle, v = event.vehicle, event.vehicle.velocity_m_s
        late = offset_position(vehicle.lat_deg, vehicle.lon_deg, -0.1 * v[0], -0.1 * v[1])
        ours = offset_position(vehicle.lat_deg, vehicle.lon_deg, *rng.normal(20, 5, 2))
        gps = make_receiver(late, GPS_SD_M, event.frame.t_mono_s)
        vehicle = replace(vehicle, lat_deg=ours[0], lon_deg=ours[1], gps=gps, t_fix_s=event.frame.t_mono_s)
        sightings.add_match(replace(event, vehicle=vehicle))
    found = sightings.compute_result()
    assert np.abs(measure_offset_error_m(found)).max() < 2.5 * found.measures["off_m"].sd
    assert found.measures["ahead_deg"].value[0] == pytest.approx(AHEAD_DEG, abs=found.measures["ahead_deg"].sd)


def relevel(event, mount, was):
    """The position of a match if its picture is levelled by another mount than it was."""
    now, before = (np.tan(np.radians((each.right_deg, each.ahead_deg))) for each in (mount, was))
    east_m, north_m = HEIGHT_M * picture_axes(event.vehicle.heading_deg) @ (now - before)
    return move_position(event.located.position, -east_m, -north_m)


class SurveyRun:
    """A surveyor that has heard a flight; `lines` are its lines of the log, `texts` what the ground was told."""

    def __init__(self, folder, flight, map_sd_m=5.0, **source):
        clock = FakeClock(0.0)
        link, config = FakeLink(clock), load_config(None, {f"source.{key}": known for key, known in source.items()})
        with FlightLog(folder / "log", clock=clock) as flight_log:
            notifier = Notifier(flight_log, link)
            watch = GpsWatch(map_sd_m, notifier, None)
            self.mounts, beside = [], read_mount(config.source)
            surveyor = SurveyReporter(notifier, watch, config.source, self.mounts.append)
            for event in flight:
                clock.now_s = event.frame.t_mono_s
                if self.mounts:
                    located = replace(event.located, position=relevel(event, self.mounts[-1], beside))
                    event = replace(event, located=located)
                watch.update(event)
                surveyor.update(event)
            self.last = clock.now_s
            surveyor.end()
        self.lines = [line for line in read_log(folder / "log") if line["kind"] == "survey"]
        self.alarms_s = [line["t_mono_s"] for line in read_log(folder / "log") if line["kind"] == "gps"]
        self.texts = [text for _, text in link.texts() if "GPS is" not in text and "GPS agrees" not in text]


def test_survey_is_reported_once_and_at_the_end(tmp_path):
    flown = SurveyRun(tmp_path, make_matches(fly_eights, 1800))
    *_, last = flown.lines
    assert 2 <= len(flown.lines) <= 5, "one for each that becomes known, and the end"
    assert last["t_mono_s"] == flown.last
    assert last["ahead_deg"] == pytest.approx(AHEAD_DEG, abs=1.0)
    assert math.dist(last["off_m"], OFF_M + SCALE * np.array(offset_m(*HOME, *last["middle"].values()))) < 1.0
    assert re.search(r"east and \d+\.\d m south .* 1\.0% ", last["said"])
    assert re.search(r"ahead .* set source\.mount_ahead_deg: 9\.\d; .* left .*mount_right_deg: -[23]", last["said"])
    assert len(flown.texts) == 8, "each of four when it is known, and at the end"
    assert all(len(text.encode()) <= 50 and not text.endswith("...") for text in flown.texts)


def make_correct_matches(way=fly_lanes, seconds=900):
    """The matches of a map and a camera that are right."""
    rng = np.random.default_rng(2)
    for event in make_matches(way, seconds):
        at = Position(*offset_position(event.vehicle.lat_deg, event.vehicle.lon_deg, *rng.normal(0, FIX_SD_M, 2)))
        yield replace(event, located=replace(event.located, position=at))


def test_survey_does_not_report_a_correct_map_and_camera(tmp_path):
    flown = SurveyRun(tmp_path, make_correct_matches())
    assert flown.texts == []
    (end,) = flown.lines
    assert end["off_m"] == pytest.approx([0.0, 0.0], abs=1.0)
    assert end["ahead_deg"] == pytest.approx(0.0, abs=1.0)


def mislead(law, flight):
    """A flight whose receiver is led to the east by a law of time."""
    for event in flight:
        away_m = law(event.frame.t_mono_s)
        vehicle = event.vehicle
        there = offset_position(vehicle.lat_deg, vehicle.lon_deg, away_m, 0.0)
        gps = replace(vehicle.gps, lat_deg=there[0], lon_deg=there[1])
        yield replace(event, vehicle=replace(vehicle, lat_deg=there[0], lon_deg=there[1], gps=gps))


@pytest.mark.parametrize("way", [fly_eights, fly_circle])
@pytest.mark.parametrize(
    "law",
    [
        lambda t_s: 0.5 * t_s,
        lambda t_s: 15.0 * (t_s > 300),
        lambda t_s: 100.0 * (t_s > 100),
        lambda t_s: 40.0 * (t_s % 100 < 60),
        lambda t_s: 40.0,
    ],
)
def test_survey_learns_nothing_from_wrong_gps(tmp_path, law, way):
    assert SurveyRun(tmp_path, mislead(law, make_correct_matches(way))).lines == []


def test_survey_withdraws_its_report_when_gps_becomes_wrong(tmp_path):
    flown = SurveyRun(tmp_path, mislead(lambda t_s: 60.0 * (t_s > 700), make_matches(fly_eights, 1200)))
    assert flown.lines[0]["off_m"]
    assert "off_m" not in flown.lines[-1]
    assert flown.lines[-1]["note"]["code"] == "SURVEY_WITHDRAWN"
    assert flown.mounts[-1].ahead_deg == pytest.approx(AHEAD_DEG, abs=1.5)


@pytest.mark.parametrize(("way", "map_sd_m"), [(fly_eights, 5.0), (fly_lanes, 1.0), (fly_circle, 5.0)])
def test_images_are_levelled_by_the_measured_mount_so_that_gps_agrees(tmp_path, way, map_sd_m):
    flown = SurveyRun(tmp_path, make_matches(way, 1800, scale=0.0), map_sd_m)
    known_s = next(line["t_mono_s"] for line in flown.lines if line["ahead_deg"])
    assert known_s < 400
    assert flown.alarms_s, "until then, each turn contradicts GPS"
    assert all(t_s < known_s + 10 for t_s in flown.alarms_s)
    assert flown.mounts[-1].ahead_deg == pytest.approx(AHEAD_DEG, abs=1.5)
    right_deg = 0.0 if way is fly_circle else RIGHT_DEG  # in one circle that is a scale, and not taken for known
    assert flown.mounts[-1].right_deg == pytest.approx(right_deg, abs=1.5)
    assert flown.lines[-1]["ahead_deg"] == pytest.approx(AHEAD_DEG, abs=1.0), "it is still what is to be set"


def test_survey_finds_spoofed_gps_after_measuring_the_mount(tmp_path):
    flown = SurveyRun(tmp_path, mislead(lambda t_s: max(0.0, t_s - 1500), make_matches(fly_eights, 1800, scale=0.0)))
    assert 1500 < min(t_s for t_s in flown.alarms_s if t_s > 1450) < 1530
    assert flown.mounts[-1].ahead_deg == pytest.approx(AHEAD_DEG, abs=1.5), "a mount that is known stays"
