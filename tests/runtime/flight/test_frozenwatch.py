"""Pictures that stay the same, or repeat, while the aircraft moves are refused; those that may stay are not."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from fakes import FakeSource, make_vehicle
from flights import select
from frozen_cameras import DOWN, CameraFlight, compress, draw_clock, encode_at_constant_bitrate, make_ground
from pictures import draw_texture

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.messages import Health
from edgevpr.runtime.flight.frozenwatch import Optics

pytestmark = pytest.mark.slow

AHEAD = Optics(focal=0.77, looks_down=False, is_level=False)
UNCHANGED = Reason(ReasonCode.IMAGES_UNCHANGED)
CHANGED = Reason(ReasonCode.IMAGES_CHANGE_AGAIN)
GIMBAL = Optics(focal=0.77, looks_down=True, is_level=True)


@pytest.fixture(scope="module")
def ground():
    return make_ground()


def encode_frozen(picture, rng, count):
    return encode_at_constant_bitrate(picture, 10 * count)[::10]


def compress_frozen(picture, rng, count):
    return [compress(picture, rng) for _ in range(count)]


def draw_clock_over_frozen(picture, rng, count):
    return [compress(draw_clock(picture, number), rng) for number in range(count)]


@pytest.mark.parametrize("harm", [encode_frozen, compress_frozen, draw_clock_over_frozen])
@pytest.mark.parametrize(("speed_m_s", "within_s"), [(10.0, 3), (5.0, 5)])
def test_frozen_watch_refuses_static_images_in_flight_until_they_change(ground, harm, speed_m_s, within_s):
    flown = CameraFlight(ground)
    for picture in harm(flown.fly_on(6, speed_m_s)[-1], flown.rng, 16):
        flown.show(picture, velocity_m_s=(speed_m_s, 0.0))
    assert flown.refused == [None] * (5 + within_s) + [UNCHANGED] * (17 - within_s)
    flown.autopilot.reset_navigation.assert_called_once()
    flown.fly_on(6, speed_m_s, start_m=180.0)
    assert flown.refused[-4:] == [None] * 4
    assert flown.notes == [str(UNCHANGED), str(CHANGED)]


@pytest.mark.parametrize(
    ("optics", "turn"),
    [
        (DOWN, lambda number: {"heading_deg": 12.0 * number}),
        (AHEAD, lambda number: {"heading_deg": 4.0 * (number % 4)}),
        (GIMBAL, lambda number: {"heading_deg": 12.0 * number}),
    ],
)
def test_frozen_watch_refuses_static_images_in_a_turn(ground, optics, turn):
    flown = CameraFlight(ground, optics)
    flown.fly_on(3, 10.0)
    still = flown.photograph()
    for number in range(16):
        flown.show(compress(still, flown.rng), **turn(number))
    assert flown.refused[:5] == [None] * 5
    assert all(flown.refused[11:])
    assert flown.notes == [str(UNCHANGED)]


@pytest.mark.parametrize("is_in_order", [True, False])
def test_frozen_watch_refuses_a_repeated_clip_in_flight(ground, is_in_order):
    flown = CameraFlight(ground)
    clip = flown.fly_on(20, 5.0)
    for number in range(40):
        shown = clip[number % 20 if is_in_order else flown.rng.integers(20)]
        flown.show(compress(shown, flown.rng), velocity_m_s=(5.0, 0.0))
    assert flown.refused[:20] == [None] * 20
    assert all(flown.refused[30:])
    assert flown.notes == [str(Reason(ReasonCode.IMAGES_REPEATED))]


@pytest.mark.parametrize(("speed_m_s", "side_s", "wind_m_s"), [(6.0, 10, 0.0), (24.0, 3, 7.5)])
def test_frozen_watch_accepts_laps_of_whole_seconds(ground, speed_m_s, side_s, wind_m_s):
    """In a square flown three times each image is that of the lap before, also if the reported way drifts off."""
    flown, east_m, north_m = CameraFlight(ground), 160.0, 80.0
    for east, north in 3 * ([(1, 0)] * side_s + [(0, 1)] * side_s + [(-1, 0)] * side_s + [(0, -1)] * side_s):
        picture, velocity_m_s = flown.photograph(east_m, north_m), (speed_m_s * east + wind_m_s, speed_m_s * north)
        assert flown.show(picture, velocity_m_s=velocity_m_s) is None
        east_m, north_m = east_m + speed_m_s * east, north_m + speed_m_s * north


def test_frozen_watch_refuses_a_clip_whose_turns_are_not_flown(ground):
    flown = CameraFlight(ground)
    turns = [30.0 * number for number in range(12)]
    clip = [flown.photograph(heading_deg=heading_deg) for heading_deg in turns]
    for picture, heading_deg in zip(clip, turns, strict=True):
        flown.show(picture, heading_deg=heading_deg)
    for picture in clip:
        flown.show(compress(picture, flown.rng), heading_deg=330.0)
    assert flown.refused[:12] == [None] * 12
    assert all(flown.refused[-6:])


@pytest.mark.parametrize(("drift_m", "tilt_deg", "every_s"), [(1.0, 1.0, 1.0), (0.1, 0.2, 1.0), (1.0, 2.5, 0.5)])
def test_frozen_watch_accepts_a_hover_in_gusts(ground, drift_m, tilt_deg, every_s):
    flown, at_m = CameraFlight(ground, every_s=every_s), np.zeros(2)
    for _ in range(60):
        at_m = 0.9 * at_m + flown.rng.normal(0, 0.44 * drift_m, 2)
        roll_deg, pitch_deg, turn_deg = flown.rng.normal(0, tilt_deg, 3)
        attitude = {"heading_deg": 90.0 + turn_deg, "roll_deg": roll_deg, "pitch_deg": pitch_deg}
        picture = flown.photograph(200.0 + at_m[0], 120.0 + at_m[1], **attitude)
        flown.show(picture, velocity_m_s=flown.rng.normal(0, 0.7, 2), **attitude)
    assert flown.refused == [None] * 60


def test_frozen_watch_accepts_a_camera_on_the_ground_while_the_heading_converges(ground):
    flown = CameraFlight(ground)
    still = flown.photograph()
    for number in range(60):
        heading_deg = 0.0 if number < 20 else 137.0
        flown.show(compress(still, flown.rng), heading_deg=heading_deg, height_m=0.2, velocity_m_s=(1.5, 0.0))
    assert flown.refused == [None] * 60


def test_frozen_watch_accepts_the_horizon_in_straight_flight(ground):
    flown = CameraFlight(ground, AHEAD)
    far = flown.photograph()
    far[:200] = 200
    for _ in range(60):
        roll_deg, pitch_deg, turn_deg = flown.rng.normal(0, 1.0, 3)
        shift = np.array([[1, 0, -8.6 * turn_deg], [0, 1, 8.6 * pitch_deg]])
        picture = cv2.warpAffine(far, shift, (640, 480), borderMode=cv2.BORDER_REFLECT)
        attitude = {"heading_deg": 90.0 + turn_deg, "pitch_deg": pitch_deg, "roll_deg": roll_deg}
        flown.show(compress(picture, flown.rng), velocity_m_s=(20.0, 0.0), **attitude)
    assert flown.refused == [None] * 60


@pytest.mark.parametrize("level", [90, 6])
def test_frozen_watch_accepts_water_fog_and_darkness_under_a_display(ground, level):
    flown = CameraFlight(ground)
    for number in range(40):
        shown = np.clip(flown.rng.normal(level, 4, (480, 640, 1)), 0, 255).astype(np.uint8).repeat(3, axis=2)
        picture = compress(draw_clock(shown, number), flown.rng)
        flown.show(picture, velocity_m_s=(20.0, 0.0), heading_deg=20.0 * number)
    assert flown.refused == [None] * 40


def test_frozen_watch_accepts_flight_along_furrows(ground):
    """Nothing in the picture moves but the noise."""
    flown = CameraFlight(ground)
    right, down = np.meshgrid(np.arange(640), np.arange(480))
    along = 0.92 * right + 0.39 * down
    for _ in range(40):
        furrows = 110 + 40 * np.sin(along / 6) + 20 * np.sin(along / 17) + flown.rng.normal(0, 4, (480, 640))
        picture = np.clip(furrows, 0, 255).astype(np.uint8)[..., None].repeat(3, axis=2)
        flown.show(compress(picture, flown.rng), velocity_m_s=(15.0, 0.0))
    assert flown.refused == [None] * 40


def test_frozen_watch_accepts_a_route_flown_again(ground):
    flown = CameraFlight(ground)
    for _ in range(3):
        start_m, north_m = 60.0 + flown.rng.uniform(0, 10), 120.0 + flown.rng.normal(0, 1.0)
        for number in range(24):
            roll_deg, pitch_deg, turn_deg = flown.rng.normal(0, 1.5, 3)
            attitude = {"heading_deg": 90.0 + turn_deg, "roll_deg": roll_deg, "pitch_deg": pitch_deg}
            picture = flown.photograph(start_m + 10.0 * number, north_m, **attitude)
            flown.show(picture, velocity_m_s=(10.0, 0.0), **attitude)
    assert flown.refused == [None] * 72


@pytest.mark.parametrize("harm", [np.nan, np.inf, 1e300])
def test_frozen_watch_survives_implausible_reports(ground, harm):
    flown = CameraFlight(ground)
    for _ in range(5):
        reported = {"heading_deg": harm, "roll_deg": harm, "velocity_m_s": (harm, harm), "height_m": harm}
        assert flown.show(flown.photograph(), **reported) is None
    assert flown.show(np.zeros((3, 4), np.uint8)) is None


def test_flight_refuses_frozen_images_and_reports_them(make_flight, clock, link):
    health, seen = [], []

    def vehicle():
        heading_deg = 10.0 * (clock.now_s - 1000.0) % 360
        return make_vehicle(50.0, 8.0, clock.now_s, heading_deg=heading_deg, roll_deg=0.0, pitch_deg=0.0)

    def read():
        health.append(link.health)
        clock.sleep(1.0)

    link.vehicle, flight = vehicle, make_flight()
    noise = np.random.default_rng(2)
    shown = [0, 1, *[2] * 12, 3, 4, 5, 6]
    pictures = [draw_texture(number, 240, 320) + noise.integers(0, 4, (240, 320), np.uint8) for number in shown]
    lines = flight.fly(FakeSource(pictures, clock, work=read), status=SimpleNamespace(write=seen.append))
    accepted = [line["accepted"] for line in select(lines, "query")]
    refused = select(lines, "unusable")
    assert 7 <= len(refused) <= 11
    assert {line["reason"]["code"] for line in refused} == {"IMAGES_UNCHANGED"}
    assert accepted == [True] * (len(shown) - len(refused))
    assert flight.end["unusable"] == 0, "the camera has failed, and no picture"
    assert [line["note"]["code"] for line in select(lines, "source")] == ["IMAGES_UNCHANGED", "IMAGES_CHANGE_AGAIN"]
    assert link.texts() == [(4, f"edgevpr: {UNCHANGED}"), (6, f"edgevpr: {CHANGED}")]
    assert str(UNCHANGED) in [status["source"] for status in seen]
    assert Health.CRITICAL in health
    assert health[-1] is Health.ACTIVE
