"""An autopilot that restarts is a new one, and one whose link is lost for some seconds is not."""

import pytest
from scripted_autopilot import Autopilot, RecordingListener
from simulated.firmware import ARDUPILOT

from edgevpr.core.types import Position
from edgevpr.mavlink.channel import Channel
from edgevpr.mavlink.wire import mavlink

IMU = mavlink.MAVLINK_MSG_ID_SCALED_IMU
RECEIVER = {"GPS1_TYPE": 1, "GPS2_TYPE": 14}
VISION = {"GPS2_TYPE": 0, "VISO_TYPE": 1}


class Aircraft(Autopilot):
    """An ArduPilot that answers for its parameters and keeps an origin until it restarts. `received` are our messages
    since the last restart, `rates` the messages that it was asked to stream."""

    def __init__(self, parameters, *, says_boot_time=True, booted_s=600.0, **settings):
        self.parameters, self.ear = dict(parameters), RecordingListener()
        self.says_boot_time, self.has_origin = says_boot_time, False
        super().__init__(booted_s=booted_s, listener=self.ear, origin=Position(46.5, 7.5, 400.0), **settings)
        self.conversation.request_position()
        self.clear()

    def clear(self):
        self.received, self.rates = [], set()

    def power_cycle(self, silent_s):
        self.take_sent()
        self.reboot(silent_s)
        self.has_origin = False
        self.clear()

    def run(self, seconds):
        """Live on, and return the texts that were sent meanwhile."""
        texts = []
        for tick in range(round(seconds * 10)):
            if tick % 10 == 0:
                self.beat()
                if self.has_origin:
                    self.send(mavlink.MAVLink_gps_global_origin_message(465_000_000, 75_000_000, 400_000))
            if self.says_boot_time and mavlink.MAVLINK_MSG_ID_ATTITUDE in self.rates:
                self.attitude()
                self.position()
            for message in self.reply(ARDUPILOT | self.parameters):
                self.received.append(message)
                texts += [message.text] if message.get_type() == "STATUSTEXT" else []
                self.has_origin |= message.get_type() == "SET_GPS_GLOBAL_ORIGIN"
                if getattr(message, "command", None) == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                    self.rates.add(int(message.param1))
            self.wait(0.1)
        return texts

    def names(self):
        return [message.get_type() for message in self.received]


@pytest.mark.parametrize(
    ("silent_s", "says_boot_time", "timesync_s"),
    [
        (1.6, True, 0.0),
        (1.6, True, None),
        (1.6, False, 0.0),
        (6.0, True, 0.0),
        (6.0, False, 0.0),
        (6.0, False, None),
        (40.0, True, None),
    ],
)
def test_power_cycle_of_any_length_is_a_new_autopilot(silent_s, says_boot_time, timesync_s, caplog):
    aircraft = Aircraft({"GPS2_TYPE": 0}, says_boot_time=says_boot_time, timesync_s=timesync_s)
    aircraft.run(20)
    assert "GPS_INPUT" not in aircraft.names()
    sending = aircraft.put_fix()
    aircraft.parameters = RECEIVER
    aircraft.power_cycle(silent_s)
    texts = aircraft.run(15)
    assert sending.answer is None
    assert any("restarted" in text for text in texts)
    assert {IMU, mavlink.MAVLINK_MSG_ID_ATTITUDE} <= aircraft.rates
    assert aircraft.names().count("GPS_INPUT") > 20
    last = [message for message in aircraft.received if message.get_type() == "GPS_INPUT"][-1]
    if timesync_s is not None:
        assert last.time_usec / 1e6 == pytest.approx(aircraft.boot_s, abs=0.5), "the time since this boot"
    assert (aircraft.ear.autopilots, aircraft.ear.channels[-1]) == (2, Channel.GPS_INPUT)
    assert caplog.text.count("restarted") == 1


def test_power_cycle_repeats_announcements_and_requests():
    aircraft = Aircraft(VISION)
    aircraft.run(20)
    assert aircraft.names().count("SET_GPS_GLOBAL_ORIGIN") == 1
    assert aircraft.names().count("ODOMETRY") > 50
    for restarts in (1, 2):
        aircraft.power_cycle(1.6)
        texts = aircraft.run(20)
        assert aircraft.names().count("SET_GPS_GLOBAL_ORIGIN") == 1
        assert aircraft.names().count("ODOMETRY") > 50
        assert IMU in aircraft.rates
        (text,) = texts
        assert ("restarted" in text, "2 times" in text) == (True, restarts == 2)
        assert aircraft.ear.channels[-2:] == [Channel.NONE, Channel.ODOMETRY]
    assert aircraft.conversation.autopilot.identity.foreign_messages == 0


@pytest.mark.parametrize("outage_s", [2.0, 8.0, 25.0])
def test_outage_without_a_restart_resets_nothing(outage_s):
    aircraft = Aircraft(VISION)
    aircraft.run(20)
    before = aircraft.conversation.autopilot.clock
    aircraft.wait(outage_s)
    aircraft.received = []
    texts = aircraft.run(20)
    assert aircraft.conversation.autopilot.clock is before
    assert (aircraft.ear.autopilots, aircraft.ear.channels) == (1, [Channel.NONE, Channel.ODOMETRY])
    assert "SET_GPS_GLOBAL_ORIGIN" not in aircraft.names()
    assert aircraft.names().count("ODOMETRY") > 150, "at once"
    assert not any("restarted" in text for text in texts)


def test_restart_is_recognised_even_if_the_new_boot_time_is_higher():
    aircraft = Aircraft(VISION, booted_s=997.0)
    aircraft.run(3)
    aircraft.wait(9.0)
    aircraft.booted_s = aircraft.clock.now_s - 7.5
    assert any("restarted" in text for text in aircraft.run(20))


def test_delayed_messages_are_not_a_restart():
    """A busy companion reads what has come in ten seconds at once."""
    aircraft = Aircraft(VISION)
    aircraft.run(20)
    held_up = [round(aircraft.boot_s * 1e3) + number * 100 for number in range(100)]
    aircraft.wait(10.0)
    for boot_ms in held_up:
        aircraft.send(mavlink.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0))
        if boot_ms % 1000 < 100:
            aircraft.beat()
    assert not any("restarted" in text for text in aircraft.run(20))
    assert aircraft.ear.autopilots == 1
