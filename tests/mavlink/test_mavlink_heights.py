"""The height above the ground, of a vehicle that flies over level ground at 584 m above sea level."""

import re

import pytest
from scripted_autopilot import ARMED, Autopilot

from edgevpr.mavlink.wire import mavlink

GROUND_M = 584.0
UNKNOWN_POSITION = 0.0, 0.0


class Vehicle:
    """A vehicle with its autopilot, whose home and origin are set at will; it reports ten times a second."""

    def __init__(self) -> None:
        self.autopilot = Autopilot()
        self.height_m, self.home_m, self.origin_m = 0.0, GROUND_M, 0.0
        self.at_deg, self.is_armed = (50.0, 8.0), False
        self.range_m = self.terrain_m = None

    def fly(self, seconds=2.0, climb_m_s=0.0, vz_cm_s=None, every_s=0.1):
        """Let time pass; return the height that the autopilot's last report gives."""
        for number in range(round(seconds / every_s)):
            self.autopilot.wait(every_s)
            self.height_m += every_s * climb_m_s
            if number % 10 == 0:
                self.autopilot.beat(ARMED if self.is_armed else 0)
            if self.range_m is not None:
                self.autopilot.range(self.range_m)
            if self.terrain_m is not None:
                self._report_terrain()
            self.report(climb_m_s, vz_cm_s)
        return self.autopilot.vehicle and self.autopilot.vehicle.height_m

    def report(self, climb_m_s=0.0, vz_cm_s=None):
        alt_m = GROUND_M + self.height_m + self.origin_m
        velocity = 0, 0, round(-100 * climb_m_s) if vz_cm_s is None else vz_cm_s
        self.autopilot.locate(self.at_deg, alt_m if any(self.at_deg) else 0.0, alt_m - self.home_m, velocity)

    def _report_terrain(self):
        """As ArduPilot 4.6 does: the height follows home."""
        above_home_m = GROUND_M + self.height_m + self.origin_m - self.home_m
        current_m = above_home_m - (self.terrain_m - GROUND_M)
        self.autopilot.send(mavlink.MAVLink_terrain_report_message(0, 0, 100, self.terrain_m, current_m, 0, 9))

    def take_off(self, height_m=100.0):
        self.fly()
        self.is_armed = True
        self.fly()
        return self.fly(height_m / 5, climb_m_s=5.0)

    def texts(self):
        texts = []
        for _ in range(4):
            self.autopilot.wait(6.0)
            texts += [text.removeprefix("edgevpr: ") for _, text in self.autopilot.texts()]
        self.report()
        return texts


@pytest.fixture
def vehicle():
    """One that has taken off, and is 100 m high."""
    vehicle = Vehicle()
    vehicle.take_off()
    return vehicle


def approx_height(height_m):
    return pytest.approx(height_m, abs=1.0)


@pytest.mark.parametrize("home_m", [GROUND_M, GROUND_M + 60.0, GROUND_M - 7.0])
def test_height_starts_at_the_ground_wherever_home_is(home_m):
    vehicle = Vehicle()
    vehicle.home_m = home_m
    assert vehicle.fly() == 0.0
    assert vehicle.take_off() == approx_height(100.0)
    assert vehicle.fly(20.0, climb_m_s=-2.0) == approx_height(60.0)
    assert vehicle.autopilot.vehicle.height_doubt_m == 0.0
    assert vehicle.texts() == []


@pytest.mark.parametrize("moved_m", [100.0, 150.0, -60.0, -GROUND_M])
@pytest.mark.parametrize("climb_m_s", [0.0, 4.0])
def test_height_is_unchanged_if_home_is_set_in_flight(vehicle, moved_m, climb_m_s):
    vehicle.home_m += moved_m
    assert vehicle.fly(climb_m_s=climb_m_s) == approx_height(vehicle.height_m)
    assert vehicle.texts() == []
    vehicle.is_armed = False
    assert vehicle.fly() == 0.0, "it stands on the ground"


@pytest.mark.parametrize("every_s", [0.1, 1.0, 12.0])
def test_height_is_unchanged_if_the_origin_is_set_in_flight(vehicle, every_s):
    vehicle.home_m, vehicle.origin_m = vehicle.home_m + 300.0, 300.0
    assert vehicle.fly(24.0, climb_m_s=0.5, every_s=every_s) == approx_height(vehicle.height_m)
    assert vehicle.texts() == []


def test_height_is_known_if_the_position_arrives_in_flight():
    vehicle = Vehicle()
    vehicle.at_deg = UNKNOWN_POSITION
    assert vehicle.take_off() is None
    vehicle.at_deg, vehicle.home_m, vehicle.origin_m = (50.0, 8.0), GROUND_M + 90.0, 90.0
    assert vehicle.fly() == approx_height(100.0)


def test_height_ignores_an_altitude_jump_and_adds_uncertainty(vehicle):
    vehicle.origin_m = 40.0
    assert vehicle.fly() == approx_height(100.0)
    assert vehicle.autopilot.vehicle.height_doubt_m == approx_height(40.0)
    assert vehicle.texts() == ["altitude jumped +40 m"]


def test_height_follows_a_climb_missing_in_the_velocity(vehicle):
    assert vehicle.fly(20.0, climb_m_s=10.0, vz_cm_s=0, every_s=1.0) == pytest.approx(300.0, abs=11.0)


def test_height_of_a_vehicle_first_seen_in_flight_starts_at_home():
    vehicle = Vehicle()
    vehicle.height_m, vehicle.is_armed = 100.0, True
    assert vehicle.fly() == approx_height(100.0)
    vehicle.home_m += 80.0
    assert vehicle.fly() == approx_height(100.0)


def test_height_of_a_px4_without_home_is_reset_once_it_has_one():
    vehicle = Vehicle()
    vehicle.height_m, vehicle.is_armed, vehicle.home_m = 100.0, True, 0.0
    vehicle.fly()
    vehicle.home_m = GROUND_M
    assert vehicle.fly() == approx_height(100.0)


def test_height_is_kept_by_a_disarmed_gliding_vehicle(vehicle):
    vehicle.is_armed = False
    assert vehicle.fly(10.0, climb_m_s=-2.0) == approx_height(80.0)


def test_height_over_terrain_is_independent_of_home():
    vehicle = Vehicle()
    vehicle.terrain_m = GROUND_M
    vehicle.take_off()
    vehicle.terrain_m = GROUND_M + 30.0
    assert vehicle.fly() == approx_height(70.0)
    vehicle.home_m += 100.0
    assert vehicle.fly() == approx_height(70.0)


def test_steps_of_the_height_at_changes_of_its_source_are_summed():
    vehicle = Vehicle()
    vehicle.take_off(30.0)
    steps_m = [vehicle.autopilot.vehicle.height_step_m]
    for range_m in (48.0, 40.0, None):  # the ground rises in between
        vehicle.range_m = range_m
        vehicle.fly()
        steps_m.append(vehicle.autopilot.vehicle.height_step_m)
    assert steps_m == pytest.approx([0.0, 18.0, 18.0, 8.0], abs=0.1)


def test_height_contradicted_by_the_range_finder_is_reported_once():
    vehicle = Vehicle()
    vehicle.take_off(30.0)
    vehicle.range_m = 37.0
    vehicle.fly(6.0)
    vehicle.range_m = 50.0
    vehicle.fly(2.0)  # over a quarry
    vehicle.range_m = 30.0
    vehicle.fly(6.0)
    heights = vehicle.autopilot.conversation.autopilot.heights
    assert heights.contradiction_m is None
    vehicle.range_m = 60.0
    assert vehicle.fly(6.0) == 60.0
    assert vehicle.autopilot.vehicle.height_doubt_m == approx_height(30.0)
    (text,) = vehicle.texts()
    assert re.findall(r"\d+ m", text) == ["30 m", "60 m"]
    vehicle.range_m = 31.0
    vehicle.fly(6.0)
    assert heights.contradiction_m is None
    assert len(vehicle.texts()) == 1
