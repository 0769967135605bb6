"""Rules of the simulated flight controllers that the contract with a real ArduPilot does not fly through, and PX4's."""

import math

import pytest
from freeflight import Piloted
from pilots import state_at
from simulated.controller import FlightController
from simulated.motion import GRAVITY_M_S2, Hover, TrueState, tilt_for

from edgevpr.lab.simulate.generated import ORIGIN
from edgevpr.mavlink import messages
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.flight.path import to_ground_acceleration

ACCEPTED, DENIED, FAILED = (getattr(mavlink, f"MAV_RESULT_{name}") for name in ("ACCEPTED", "DENIED", "FAILED"))
NOT_NOW, UNSUPPORTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED, mavlink.MAV_RESULT_UNSUPPORTED


class Flown:
    """A vehicle in the air with GPS."""

    def __init__(self, vehicle: str, **parameters: float) -> None:
        self.controller = Piloted(vehicle, **parameters)
        self.kind, self.motion = self.controller.kind, self.controller.motion
        self.said = []
        self.now_s = 0.0

    def wait(self, seconds: float) -> "Flown":
        self.now_s += seconds
        self.said = self.controller.advance(self.now_s)
        return self

    def in_air(self) -> "Flown":
        self.wait(10)
        self.controller.arm()
        self.motion.take_off(30)
        return self.wait(30)

    def tell(self, message):
        """Send a message; return the answers."""
        return self.controller.receive(message)

    def command(self, number: int, *values: float) -> int:
        padded = [*values, *[0] * (7 - len(values))]
        return self.tell(mavlink.MAVLink_command_long_message(1, 1, number, 0, *padded))[0].result

    def fix(self, north_m: float = 0.0, age_s: float = 0.0, **changes: float) -> int:
        """Send a fix so far north of the truth."""
        place = self.truth
        here = Fix(place.lat_deg + north_m / 111_195, place.lon_deg, 5.0, self.now_s - age_s)
        command = messages.position_fix(here, self.now_s, target_system=1)
        for field, value in changes.items():
            setattr(command, field, value)
        return self.tell(command)[0].result

    @property
    def truth(self):
        return self.controller.brain.truth

    @property
    def error_m(self) -> float:
        return self.controller.error_m

    @property
    def flags(self) -> int:
        return self.controller.brain.flags()


def lost(vehicle: str, wind_m_s: float = 6.0, **parameters: float) -> Flown:
    """Return a vehicle that has just lost GPS, in a wind that it does not know."""
    flown = Flown(vehicle, **parameters).in_air()
    flown.controller.set("SIM_GPS1_ENABLE", 0)
    flown.controller.set("SIM_WIND_SPD", wind_m_s)
    return flown


def test_ardupilot_fails_a_fix_for_a_second_after_the_loss_and_without_an_origin():
    assert Flown("arduplane", SIM_GPS1_ENABLE=0).wait(20).fix() == FAILED
    flown = lost("arduplane")
    flown.wait(0.5)
    assert flown.fix() == FAILED
    flown.wait(1)
    assert flown.fix() == ACCEPTED


def gps_input(place: TrueState, north_m: float = 0.0, satellites: int = 6, fix_type: int = 3, accuracy_m: float = 1.0):
    velocity_m_s = place.velocity_m_s.real, place.velocity_m_s.imag, 0.0
    at = place.lat_deg + north_m / 111_195, place.lon_deg, place.alt_m
    message = messages.gps_input(state_at(0.0, *at, velocity_m_s, accuracy_m), 1, 0.0, None)
    message.satellites_visible, message.fix_type = satellites, fix_type
    return message


def beside_own(seconds: float = 25.0, north_m: float = 1.0, told=None, **parameters: float) -> Flown:
    """Fly a copter for so long beside our positions, which are `north_m` off, with a plain 3D fix of its receiver."""
    flown = Flown("arducopter", SIM_GPS1_TYPE=5, GPS2_TYPE=14, **parameters).in_air()
    for _ in range(round(seconds * 10)):
        flown.tell(gps_input(flown.truth, north_m, **(told or {})))
        flown.wait(0.1)
    return flown


@pytest.mark.parametrize(
    ("switch", "satellites", "seconds", "is_ours"),
    [
        (1, 7, 25, False),
        (1, 6, 25, False),
        (1, 5, 17, False),
        (1, 5, 25, True),
        (1, 4, 4, True),
        (0, 0, 25, False),
        (4, 0, 25, False),
    ],
)
def test_primary_receiver_is_that_with_more_satellites(switch, satellites, seconds, is_ours):
    flown = beside_own(1, GPS_AUTO_SWITCH=switch)
    flown.controller.brain.receivers._switched_s = flown.now_s
    flown.controller.set("SIM_GPS1_NUMSATS", satellites)
    for _ in range(round(seconds * 10) + 15):
        flown.tell(gps_input(flown.truth, 1.0))
        flown.wait(0.1)
    uses_ours = flown.controller.brain.receivers.primary is flown.controller.brain.receivers.reports[1]
    assert uses_ours == is_ours


def test_primary_receiver_with_better_fix_wins_at_once():
    flown = beside_own(1, told={"fix_type": 4})
    assert flown.controller.brain.receivers.primary.fix_type == 4
    assert flown.wait(5).controller.brain.receivers.primary.fix_type == 3, "ours is silent"


def test_receivers_are_blended_by_their_accuracies():
    assert beside_own(20, told={"accuracy_m": 0.3}, GPS_AUTO_SWITCH=2).error_m == pytest.approx(0.5, abs=0.1)
    assert beside_own(20, told={"accuracy_m": 3.0}, GPS_AUTO_SWITCH=2).error_m == pytest.approx(0.25, abs=0.1)
    assert beside_own(20, told={"fix_type": 1}, GPS_AUTO_SWITCH=2).error_m < 0.1


def hovering(steps: int, told, **parameters: float) -> tuple[FlightController, Hover]:
    """Let a copter that obeys its estimate hover for so many tenths of a second, and be `told` a message in each."""
    motion = Hover(ORIGIN, 60.0)
    controller = FlightController("arducopter", motion, gps=True)
    for name, value in parameters.items():
        controller.set(name, value)
    for number in range(steps):
        controller.advance(number / 10)
        if message := told(controller):
            controller.receive(message)
    return controller, motion


def test_vehicle_that_obeys_its_estimate_is_flown_away_by_wrong_positions():
    setup = {"GPS2_TYPE": 14, "GPS_PRIMARY": 1, "GPS_AUTO_SWITCH": 4}
    controller, motion = hovering(600, lambda controller: gps_input(controller.brain.truth, 10.0), **setup)
    assert (motion.away_m, controller.error_m) == pytest.approx((10.0, 10.0), abs=0.5)
    controller, motion = hovering(600, lambda controller: None, **setup)
    assert motion.away_m < 0.5


def test_vehicle_that_receives_its_own_estimate_runs_away_with_a_tilt():
    def own(controller):
        brain = controller.brain
        message = gps_input(brain.truth, accuracy_m=5.0)
        velocity_m_s = brain.velocity_m_s
        message.lat, message.lon = (round(each * 1e7) for each in brain.point)
        message.ve, message.vn = velocity_m_s.real, velocity_m_s.imag
        return message if brain.now_s > 20 else None

    controller, motion = hovering(950, own, GPS2_TYPE=14, GPS_PRIMARY=1, GPS_AUTO_SWITCH=4)
    assert 100 < motion.away_m < 500
    assert controller.error_m == pytest.approx(motion.away_m, rel=0.1)
    assert 0.3 < math.degrees(abs(controller.brain.tilt)) < 5


def odometry(north_m: float, frame: int = 20, quality: int = 0):
    return mavlink.MAVLink_odometry_message(
        0, frame, 12, north_m, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [0.01] * 21, [0.01] * 21, quality=quality
    )


def test_copter_flies_by_odometry_without_any_gps():
    flown = Flown("arducopter", SIM_GPS1_ENABLE=0, VISO_TYPE=1, EK3_SRC1_POSXY=6, VISO_QUAL_MIN=10).wait(1)
    assert flown.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == FAILED
    origin = mavlink.MAVLink_set_gps_global_origin_message(1, round(ORIGIN.lat_deg * 1e7), 1491652300, 584_000)
    assert [each.get_type() for each in flown.tell(origin)] == ["GPS_GLOBAL_ORIGIN"]
    assert flown.tell(origin) == [], "it is set once"
    for message in (odometry(0, frame=1), odometry(0, quality=5)):
        for _ in range(200):
            flown.tell(message)
            flown.wait(0.1)
        assert flown.flags & mavlink.EKF_CONST_POS_MODE, "the wrong frame, or too poor"
    for _ in range(100):
        flown.tell(odometry(0, quality=50))
        flown.wait(0.1)
    assert flown.flags & mavlink.EKF_POS_HORIZ_ABS
    assert flown.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == ACCEPTED
    flown.wait(0.5)
    assert "VisOdom" in flown.controller.why_not_arm()


def sensed(flown: Flown, north_m: float = 0.0, eph_m: float = 5.0, number: int = 1):
    at = flown.truth.lat_deg + north_m / 111_195, flown.truth.lon_deg
    message = messages.position_sensor(state_at(0.0, *at, accuracy_m=eph_m))
    message.id = number
    return message


def test_px4_fuses_message_296():
    flown = lost("px4-copter").wait(0.5)
    for _ in range(60):
        flown.tell(sensed(flown))
        flown.wait(0.5)
    assert flown.error_m < 5
    assert flown.flags & mavlink.ESTIMATOR_POS_HORIZ_ABS, "no failsafe"
    fused = mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
    assert flown.flags & fused
    for _ in range(14):
        flown.tell(sensed(flown, eph_m=0.0))
        flown.tell(sensed(flown, number=2))  # of another slot
        flown.wait(0.5)
    assert not flown.flags & (mavlink.ESTIMATOR_POS_HORIZ_ABS | fused)


def sends(flown: Flown, seconds: float, north_m: float, **how) -> Flown:
    for _ in range(round(seconds * 10)):
        flown.tell(sensed(flown, north_m, **how))
        flown.wait(0.1)
    return flown


def test_px4_refuses_gps_that_contradicts_while_ours_is_active_and_resets_to_it_when_ours_is_silent():
    flown = sends(lost("px4-copter", wind_m_s=0).wait(10), 10, north_m=100.0, eph_m=1.0)
    assert flown.error_m == pytest.approx(100, abs=10)
    flown.controller.set("SIM_GPS1_ENABLE", 1)
    sends(flown, 40, north_m=100.0, eph_m=1.0)
    assert flown.error_m == pytest.approx(100, abs=10)
    assert flown.flags & mavlink.ESTIMATOR_GPS_GLITCH
    assert flown.wait(4).error_m > 50, "it waits five seconds for ours"
    assert flown.wait(3).error_m < 1
    assert not flown.flags & mavlink.ESTIMATOR_GPS_GLITCH


@pytest.mark.parametrize("acceleration_m_s2", [3 + 1j, -2j, 0j])
def test_accelerometers_and_attitude_show_the_acceleration_and_the_tilt(acceleration_m_s2):
    controller = FlightController("px4-copter", Hover(ORIGIN, 60.0), gps=True)
    brain, tilt = controller.brain, 0.02 + 0.01j
    roll_deg, pitch_deg = tilt_for(acceleration_m_s2, 30.0)
    brain.truth = TrueState(
        lat_deg=47.0, lon_deg=8.0, alt_m=0.0, roll_deg=roll_deg, pitch_deg=pitch_deg, heading_deg=30.0,
        acceleration_m_s2=acceleration_m_s2,
    )  # fmt: skip
    for error in (0j, tilt):
        brain.estimator._state[2] = error
        imu, attitude = (controller.reports[number](brain) for number in (26, 30))
        force_m_s2 = (imu.xacc * GRAVITY_M_S2 / 1000, imu.yacc * GRAVITY_M_S2 / 1000, imu.zacc * GRAVITY_M_S2 / 1000)
        angles_deg = (math.degrees(each) for each in (attitude.roll, attitude.pitch, attitude.yaw))
        felt = complex(*to_ground_acceleration(force_m_s2, *angles_deg))
        assert felt == pytest.approx(acceleration_m_s2 + GRAVITY_M_S2 * error, abs=0.05)
