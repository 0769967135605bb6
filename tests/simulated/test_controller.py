"""What other tests rest on: the simulated flight controllers take, refuse and follow positions as real ones were seen
to do (an ArduPilot 4.7-dev, a PX4 1.17.0 and a 1.18-beta1; `benchmarks/rig` flies those)."""

import math

import pytest

from edgevpr.lab.simulate.generated import ORIGIN
from edgevpr.mavlink import messages
from edgevpr.mavlink.messages import Fix, MotionState
from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.flight.path import to_ground_acceleration
from simulated.controller import FlightController
from simulated.motion import GRAVITY_M_S2, AlongTrack, Hover, Motion, TrueState, compute_tilt, displace

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED
FAILED = mavlink.MAV_RESULT_FAILED
NOT_NOW = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
HAS_POSITION = mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_POS_HORIZ_ABS
FUSES = mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
FUSES_ANY = mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
HOME = ORIGIN.lat_deg, ORIGIN.lon_deg
SPEED_M_S = {"plane": 22.0, "copter": 0.0}
FLIGHT_S = 1000.0
ATTITUDE = 30
IMU = 26
SECOND = {"SIM_GPS1_TYPE": 5, "GPS2_TYPE": 14}  # the receiver's fix is a plain 3D one, as ours is


class Vehicle:
    """A vehicle 20 s after its start with GPS. Without a `motion` a plane flies straight on, and a copter stays."""

    def __init__(self, vehicle: str, motion: Motion | None = None, **parameters: float) -> None:
        east_m = SPEED_M_S[vehicle.removeprefix("ardu").removeprefix("px4-")] * FLIGHT_S
        ends = (0.0, HOME), (FLIGHT_S, displace(HOME, complex(east_m)))
        level = {"alt_m": 600.0, "roll_deg": 0.0, "pitch_deg": 0.0, "heading_deg": 90.0}
        track = [TrueState(t_s=t_s, lat_deg=at[0], lon_deg=at[1], **level) for t_s, at in ends]
        self.controller = FlightController(vehicle, motion or AlongTrack(track), gps=True)
        self.brain, self.now_s = self.controller.brain, 0.0
        self.brain.motion.begin(0.0)
        self.set(**parameters).wait(20)

    def set(self, **parameters: float) -> "Vehicle":
        for name, value in parameters.items():
            self.controller.set(name, value)
        return self

    def wait(self, seconds: float, message=None) -> "Vehicle":
        """Fly on. Each 0.1 s it receives what `message` makes of it."""
        for _ in range(round(seconds * 10)):
            if message:
                self.controller.receive(message(self))
            self.now_s += 0.1
            self.controller.advance(self.now_s + 1e-6)
        return self

    def command(self, number: int, *values: float) -> int:
        padded = [*values, *[0] * (7 - len(values))]
        return self.controller.receive(mavlink.MAVLink_command_long_message(1, 1, number, 0, *padded))[0].result

    def fix(self, north_m: float = 0.0, age_s: float = 0.0, **changes: float) -> int:
        """Send a fix so far north of the truth."""
        lat_deg, lon_deg = displace(self.brain.truth.point, 1j * north_m)
        fix = Fix(lat_deg, lon_deg, 5.0, self.now_s - age_s)
        command = messages.make_position_fix(fix, self.now_s, target_system=1)
        for field, value in changes.items():
            setattr(command, field, value)
        return self.controller.receive(command)[0].result

    def state(self, north_m: float, accuracy_m: float = 1.0) -> MotionState:
        """Return what edgevpr knows of a motion so far north of the true one."""
        lat_deg, lon_deg = displace(self.brain.truth.point, 1j * north_m)
        velocity_m_s = self.brain.truth.velocity_m_s
        return MotionState(
            t_mono_s=self.now_s,
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_m=600.0,
            velocity_m_s=(velocity_m_s.real, velocity_m_s.imag, 0.0),
            accuracy_m=accuracy_m,
            alt_accuracy_m=1.0,
            speed_accuracy_m_s=0.3,
        )

    @property
    def error_m(self) -> float:
        return self.controller.error_m

    @property
    def flags(self) -> int:
        return self.brain.flags()


def lose_gps(vehicle: str, wind_m_s: float = 6.0, **parameters: float) -> Vehicle:
    """Return a vehicle that has just lost GPS, in a wind that it does not know."""
    return Vehicle(vehicle, **parameters).set(SIM_GPS1_ENABLE=0, SIM_WIND_SPD=wind_m_s)


def gps_input(north_m: float = 1.0, accuracy_m: float = 1.0, fix_type: int = 3, satellites: int = 6):
    def make(flown: Vehicle):
        message = messages.make_gps_input(flown.state(north_m, accuracy_m), 1, 0.0, None)
        message.fix_type, message.satellites_visible = fix_type, satellites
        return message

    return make


def make_sensor_position(north_m: float = 0.0, eph_m: float = 1.0, slot: int = 1):
    def make(flown: Vehicle):
        message = messages.make_position_sensor(flown.state(north_m, eph_m), 1)
        message.id = slot
        return message

    return make


def make_odometry(frame: int = mavlink.MAV_FRAME_LOCAL_FRD, quality: int = 50):
    return lambda flown: mavlink.MAVLink_odometry_message(
        0, frame, 12, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [0.01] * 21, [0.01] * 21, quality=quality
    )


def test_fix_fails_with_gps_and_for_a_second_after_its_loss_and_is_denied_in_a_wrong_form():
    flown = Vehicle("arduplane")
    assert flown.fix() == FAILED
    assert flown.fix(frame=5) == FAILED, "the form is right, the time is not"
    assert [flown.fix(frame=3), flown.fix(frame=6), flown.fix(z=100.0)] == [DENIED] * 3
    assert flown.command(mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 0, 0, 5, 0, *HOME) == UNSUPPORTED
    flown.set(SIM_GPS1_ENABLE=0).wait(0.5)
    assert flown.fix() == FAILED
    assert flown.wait(1).fix() == ACCEPTED


def test_plane_drifts_in_an_unknown_wind_until_a_fix_or_gps():
    known = Vehicle("arduplane", SIM_WIND_SPD=6).wait(20).set(SIM_GPS1_ENABLE=0)
    assert known.wait(60).error_m < 10
    flown = lose_gps("arduplane").wait(150)
    assert flown.error_m == pytest.approx(767, rel=0.05), "as a real one"
    assert flown.flags & HAS_POSITION == mavlink.EKF_POS_HORIZ_REL
    assert not flown.flags & mavlink.EKF_CONST_POS_MODE
    assert flown.fix(param3=math.nan) == ACCEPTED, "an accuracy may be missing"
    assert flown.error_m < 1
    assert flown.wait(10).error_m > 40, "it drifts on"
    then = flown.brain.truth.point
    assert flown.wait(2).fix(age_s=2.0, x=round(then[0] * 1e7), y=round(then[1] * 1e7)) == ACCEPTED
    assert flown.error_m < 12, "brought forward by 44 m, and 5 m/s wrong"
    assert flown.set(SIM_GPS1_ENABLE=1).wait(15).error_m < 1
    assert flown.fix() == FAILED


def test_second_receiver_takes_over_but_a_jump_is_not_followed_at_once():
    flown = Vehicle("arducopter", **SECOND).wait(5, gps_input()).set(SIM_GPS1_ENABLE=0).wait(25, gps_input())
    assert flown.error_m == pytest.approx(1, abs=0.2)
    assert flown.flags & mavlink.EKF_POS_HORIZ_ABS
    assert flown.wait(4, gps_input(north_m=25.0)).error_m < 8
    assert flown.brain.test_ratio > 1
    assert flown.wait(5, gps_input()).brain.test_ratio < 1


def test_copter_without_gps_loses_its_position_despite_a_fix():
    flown = lose_gps("arducopter").wait(4)
    assert flown.fix() == ACCEPTED
    assert flown.wait(2).flags & HAS_POSITION
    assert not flown.wait(2).flags & HAS_POSITION
    assert flown.wait(8).flags & mavlink.EKF_CONST_POS_MODE
    assert flown.fix() == FAILED


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
def test_primary_receiver_has_more_satellites(switch, satellites, seconds, is_ours):
    flown = Vehicle("arducopter", GPS_AUTO_SWITCH=switch, **SECOND)
    receivers = flown.brain.receivers
    receivers._switched_s = flown.now_s
    flown.set(SIM_GPS1_NUMSATS=satellites).wait(seconds + 1.5, gps_input())
    assert (receivers.primary is receivers.reports[1]) == is_ours


@pytest.mark.parametrize(
    ("told", "parameters", "error_m"),
    [
        ({}, {"GPS_PRIMARY": 1, "GPS_AUTO_SWITCH": 0}, 1.0),
        ({}, {"GPS_PRIMARY": 1, "GPS_AUTO_SWITCH": 4}, 1.0),
        ({}, {"GPS_PRIMARY": 0, "GPS_AUTO_SWITCH": 4}, 0.0),
        ({"accuracy_m": 0.3}, {"GPS_AUTO_SWITCH": 2}, 0.5),
        ({"accuracy_m": 3.0}, {"GPS_AUTO_SWITCH": 2}, 0.25),
        ({"fix_type": 1}, {"GPS_AUTO_SWITCH": 2}, 0.0),
    ],
)
def test_receivers_are_chosen_or_blended_by_their_accuracies(told, parameters, error_m):
    flown = Vehicle("arducopter", **SECOND, **parameters).wait(20, gps_input(**told))
    assert flown.error_m == pytest.approx(error_m, abs=0.1)


def test_copter_uses_odometry_of_the_correct_frame_and_quality():
    flown = Vehicle("arducopter", VISO_TYPE=1, EK3_SRC2_POSXY=6, VISO_QUAL_MIN=10)
    assert flown.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 4) == DENIED
    assert flown.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 2) == ACCEPTED
    for message in (make_odometry(frame=mavlink.MAV_FRAME_LOCAL_NED), make_odometry(quality=5)):
        assert not flown.wait(9, message).flags & HAS_POSITION
    assert flown.wait(10, make_odometry()).flags & mavlink.EKF_POS_HORIZ_ABS


OUR_RECEIVER_PRIMARY = {"GPS2_TYPE": 14, "GPS_PRIMARY": 1, "GPS_AUTO_SWITCH": 4}


def test_vehicle_that_follows_its_estimate_is_misled_by_wrong_positions():
    motion = Hover(ORIGIN, 60.0)
    flown = Vehicle("arducopter", motion, **OUR_RECEIVER_PRIMARY)
    assert motion.away_m < 0.5
    flown.wait(60, gps_input(north_m=10.0))
    assert (motion.away_m, flown.error_m) == pytest.approx((10.0, 10.0), abs=0.5)


def test_vehicle_that_receives_its_own_estimate_diverges_with_a_tilt():
    def make_own(flown):
        brain, message = flown.brain, gps_input(accuracy_m=5.0)(flown)
        message.lat, message.lon = (round(angle * 1e7) for angle in brain.point)
        message.ve, message.vn = brain.velocity_m_s.real, brain.velocity_m_s.imag
        return message

    motion = Hover(ORIGIN, 60.0)
    flown = Vehicle("arducopter", motion, **OUR_RECEIVER_PRIMARY).wait(75, make_own)
    assert 100 < motion.away_m < 500
    assert flown.error_m == pytest.approx(motion.away_m, rel=0.1)
    assert 0.3 < math.degrees(abs(flown.brain.tilt)) < 5


def test_px4_accepts_a_fix_at_any_time_and_has_no_frame():
    flown = Vehicle("px4-plane")
    assert flown.fix() == ACCEPTED, "with GPS too"
    assert flown.set(SIM_GPS1_ENABLE=0, SIM_WIND_SPD=6).wait(60).error_m > 200
    assert flown.fix(frame=mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, param1=math.nan, param3=math.nan) == ACCEPTED
    assert flown.error_m < 1
    assert flown.brain.estimator.sd_m == 50, "where the sender says none"
    assert flown.fix(param2=math.nan) == NOT_NOW
    assert flown.fix(x=1_000_000_000) == FAILED


def test_px4_fuses_message_296_of_its_slot_and_flags_it():
    flown = Vehicle("px4-copter", EKF2_GPS_CTRL=0).wait(8)
    assert flown.brain.receivers.primary.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX
    assert not flown.flags & (FUSES | FUSES_ANY), "the flags alone show a receiver that is not used"
    assert flown.wait(6, make_sensor_position(2.0)).flags & (FUSES | FUSES_ANY) == FUSES | FUSES_ANY
    assert flown.error_m == pytest.approx(2, abs=0.5)
    for ignored in (make_sensor_position(2.0, eph_m=0.0), make_sensor_position(2.0, slot=2)):
        assert not flown.wait(7, ignored).flags & (mavlink.ESTIMATOR_POS_HORIZ_ABS | FUSES)


def test_px4_fuses_odometry_by_another_flag():
    flown = Vehicle("px4-copter", EKF2_EV_CTRL=1).set(EKF2_GPS_CTRL=0).wait(8)
    flown.wait(6, lambda flown: messages.make_vision_position(flown.state(2.0), flown.brain.origin))
    assert flown.flags & (FUSES | FUSES_ANY) == FUSES_ANY
    assert flown.error_m == pytest.approx(2, abs=0.5)
    assert not flown.wait(1).flags & FUSES_ANY


def test_px4_refuses_contradicting_gps_until_our_positions_stop():
    flown = lose_gps("px4-copter", wind_m_s=0).wait(10).wait(10, make_sensor_position(100.0))
    assert flown.error_m == pytest.approx(100, abs=10)
    flown.set(SIM_GPS1_ENABLE=1).wait(40, make_sensor_position(100.0))
    assert flown.error_m == pytest.approx(100, abs=10)
    assert flown.flags & mavlink.ESTIMATOR_GPS_GLITCH
    assert flown.wait(4).error_m > 50, "it waits five seconds for ours"
    assert flown.wait(3).error_m < 1
    assert not flown.flags & mavlink.ESTIMATOR_GPS_GLITCH


def test_px4_with_good_gps_fuses_only_our_positions_within_the_gate():
    flown = Vehicle("px4-copter").wait(20, make_sensor_position(100.0))
    assert flown.error_m < 0.1
    assert 0.05 < flown.wait(20, make_sensor_position(2.0)).error_m < 1


def test_px4_stops_fusing_a_spoofed_receiver_after_seven_seconds():
    flown = Vehicle("px4-copter").set(SIM_GPS_SPOOF=1)
    assert flown.wait(6).flags & FUSES
    assert not flown.wait(3).flags & FUSES
    assert flown.set(SIM_GPS_SPOOF=0).wait(2).flags & FUSES


@pytest.mark.parametrize("acceleration_m_s2", [3 + 1j, -2j, 0j])
def test_accelerometers_and_attitude_show_the_acceleration_and_the_tilt(acceleration_m_s2):
    controller = FlightController("px4-copter", Hover(ORIGIN, 60.0), gps=True)
    brain, tilt = controller.brain, 0.02 + 0.01j
    roll_deg, pitch_deg = compute_tilt(acceleration_m_s2, 30.0)
    brain.truth = TrueState(
        lat_deg=47.0, lon_deg=8.0, alt_m=0.0, roll_deg=roll_deg, pitch_deg=pitch_deg, heading_deg=30.0,
        acceleration_m_s2=acceleration_m_s2,
    )  # fmt: skip
    for error in (0j, tilt):
        brain.estimator._state[2] = error
        imu, attitude = (controller.reports[number](brain) for number in (IMU, ATTITUDE))
        force_m_s2 = (imu.xacc * GRAVITY_M_S2 / 1000, imu.yacc * GRAVITY_M_S2 / 1000, imu.zacc * GRAVITY_M_S2 / 1000)
        angles_deg = (math.degrees(each) for each in (attitude.roll, attitude.pitch, attitude.yaw))
        felt = complex(*to_ground_acceleration(force_m_s2, *angles_deg))
        assert felt == pytest.approx(acceleration_m_s2 + GRAVITY_M_S2 * error, abs=0.05)
