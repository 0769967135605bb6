"""How well the autopilot knows where it is: by GPS, by its filter, by a fix that it took, and less and less since."""

import math

import pytest
from fakes import FakeClock

from edgevpr.mavlink.conversation import Conversation, LinkSettings
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.vehicle import DRIFT_M_S, GPS_SD_M
from edgevpr.mavlink.wire import mavlink

ABS, REL, CONST_POS = mavlink.EKF_POS_HORIZ_ABS, mavlink.EKF_POS_HORIZ_REL, mavlink.EKF_CONST_POS_MODE
ACCEPTED, FAILED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_FAILED


class Autopilot:
    """An autopilot at 50, 8 that says what it is told to, into a conversation without a port."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.conversation = Conversation(LinkSettings(), self.clock)
        self._packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.beat()

    def say(self, message):
        self.conversation.hear(message.pack(self._packer), self.clock.now_s, None)

    def beat(self):
        self.say(mavlink.MAVLink_heartbeat_message(1, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4, 3))

    def gps(self, fix_type=3, h_acc=0, message=mavlink.MAVLink_gps_raw_int_message):
        second = () if message is mavlink.MAVLink_gps_raw_int_message else (0, 0)
        self.say(message(0, fix_type, 500_000_000, 80_000_000, 0, 80, 120, 0, 0, 14, *second, h_acc=h_acc))

    def filter(self, flags):
        self.say(mavlink.MAVLink_ekf_status_report_message(flags, 0.1, 0.1, 0.1, 0.1, 0.1))

    def px4_filter(self, accuracy_m, flags=ABS):
        self.say(mavlink.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, accuracy_m, 1.0))

    def take_fix(self, result, accuracy_m=12.0):
        """Let a fix be sent, and answer it."""
        self.beat()
        sending = self.conversation.fixes.put(Fix(50.0, 8.0, accuracy_m, self.clock.now_s), self.clock.now_s)
        while (packet := self.conversation.next_packet()) and packet[1] is None:
            pass
        self.conversation.note_departed([sending])
        self.say(mavlink.MAVLink_command_ack_message(43003, result, target_system=1, target_component=197))

    def wait(self, seconds):
        self.clock.now_s += seconds

    def sd_m(self):
        """The certainty that comes with its next report."""
        self.say(mavlink.MAVLink_global_position_int_message(0, 500_000_000, 80_000_000, 0, 0, 0, 0, 0, 0))
        return self.conversation.autopilot.vehicle.position_sd_m


@pytest.fixture
def autopilot():
    return Autopilot()


@pytest.mark.parametrize("message", [mavlink.MAVLink_gps_raw_int_message, mavlink.MAVLink_gps2_raw_message])
@pytest.mark.parametrize(("h_acc", "sd_m"), [(1800, 1.8), (0, GPS_SD_M), (2**32 - 1, GPS_SD_M)])
def test_with_gps_it_is_that_of_the_receiver(autopilot, message, h_acc, sd_m):
    autopilot.gps(h_acc=h_acc, message=message)
    assert autopilot.sd_m() == pytest.approx(sd_m)


def test_of_two_receivers_the_better_one_counts(autopilot):
    autopilot.gps(h_acc=9000, message=mavlink.MAVLink_gps2_raw_message)
    autopilot.gps(h_acc=2000)
    assert autopilot.sd_m() == pytest.approx(2.0)


def test_it_is_unknown_where_the_position_was_never_known(autopilot):
    autopilot.filter(ABS | REL)
    assert autopilot.sd_m() is None


def test_it_grows_from_the_loss_of_gps_on(autopilot):
    autopilot.gps(h_acc=3000)
    autopilot.sd_m()
    autopilot.gps(fix_type=1)
    for after_s in (10.0, 300.0):
        autopilot.wait(after_s)
        assert autopilot.sd_m() > 0.9 * DRIFT_M_S * after_s
    assert autopilot.sd_m() == pytest.approx(math.hypot(3.0, DRIFT_M_S * 310))


@pytest.mark.parametrize("flags", [0, CONST_POS, ABS | REL | CONST_POS, mavlink.EKF_ATTITUDE])
def test_a_filter_that_says_it_has_no_position_ends_it(autopilot, flags):
    autopilot.gps()
    autopilot.sd_m()
    autopilot.gps(fix_type=1)
    autopilot.filter(flags)
    assert autopilot.sd_m() is None
    autopilot.filter(REL)
    assert autopilot.sd_m() is None, "where it had stood still meanwhile, it does not know"
    autopilot.gps()
    assert autopilot.sd_m() == GPS_SD_M


def test_a_filter_that_reckons_has_a_position(autopilot):
    autopilot.gps()
    autopilot.sd_m()
    autopilot.gps(fix_type=1)
    autopilot.wait(8.0)
    autopilot.filter(REL)
    assert autopilot.sd_m() == pytest.approx(math.hypot(GPS_SD_M, DRIFT_M_S * 8))


def test_a_fix_that_it_took_is_where_it_reckons_from(autopilot):
    autopilot.gps()
    autopilot.sd_m()
    autopilot.gps(fix_type=1)
    autopilot.wait(100.0)
    autopilot.take_fix(FAILED)
    assert autopilot.sd_m() > 200
    autopilot.take_fix(ACCEPTED, accuracy_m=12.0)
    assert autopilot.sd_m() == pytest.approx(12.0)
    autopilot.wait(4.0)
    assert autopilot.sd_m() == pytest.approx(math.hypot(12.0, DRIFT_M_S * 4))


def test_a_filter_that_says_how_good_it_is_is_believed_while_it_speaks(autopilot):
    autopilot.gps(h_acc=3000)
    autopilot.sd_m()
    autopilot.gps(fix_type=1)
    autopilot.wait(10.0)
    autopilot.px4_filter(14.0)
    assert autopilot.sd_m() == 14.0
    autopilot.wait(5.0)
    assert autopilot.sd_m() == pytest.approx(math.hypot(3.0, DRIFT_M_S * 15)), "silent"


@pytest.mark.parametrize("nothing", [0.0, math.nan, math.inf])
def test_an_accuracy_that_is_none_is_not_believed(autopilot, nothing):
    autopilot.gps(h_acc=3000)
    autopilot.px4_filter(nothing)
    assert autopilot.sd_m() == pytest.approx(3.0)


def test_another_autopilot_is_not_known_as_well(autopilot):
    autopilot.gps()
    assert autopilot.sd_m() == GPS_SD_M
    autopilot._packer = mavlink.MAVLink(None, srcSystem=9, srcComponent=1)
    for _ in range(60):
        autopilot.wait(1.0)
        autopilot.beat()
    assert autopilot.conversation.autopilot.system_id == 9
    assert autopilot.sd_m() is None
