"""The autopilot's clock: how it is learnt by TIMESYNC, and the time stamps that are made by it."""

import math

import pytest
from scripted_autopilot import Autopilot, RecordingListener

from edgevpr.mavlink.channel import Channel, ChannelChoice
from edgevpr.mavlink.clock import AutopilotClock
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.parameters import Decision
from edgevpr.mavlink.wire import mavlink

PX4 = mavlink.MAV_AUTOPILOT_PX4
WRAP_MS = 2**32


def make_autopilot(channel, firmware=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, lag_s=0.0):
    """An autopilot that booted 400 s ago, when our clock stood at 600 s, and that a channel has been chosen for."""
    autopilot = Autopilot(firmware, booted_s=600.0, listener=RecordingListener())
    autopilot.conversation.autopilot.selector._decision = Decision(ChannelChoice(channel, "for a test", 1, lag_s))
    autopilot.conversation.autopilot.origin = 47.0, 8.0, 500.0
    return autopilot


def wait_for_message(autopilot, name):
    """The next message of this name, and when it was sent; none for a second: None."""
    for _ in range(40):
        autopilot.wait(0.025)
        for message in autopilot.take_sent():
            if message.get_type() == name:
                return message, autopilot.clock.now_s
    return None


def test_timestamps_are_in_autopilot_time_or_for_px4_in_ours():
    autopilot = make_autopilot(Channel.COMMAND)
    autopilot.put_fix()
    (fix,) = [message for message in autopilot.take_sent() if message.get_type() == "COMMAND_INT"]
    assert fix.param1 == pytest.approx(autopilot.boot_s, abs=1e-3)
    odometry, now_s = wait_for_message(make_autopilot(Channel.ODOMETRY), "ODOMETRY")
    assert odometry.time_usec == pytest.approx((now_s - 600.0) * 1e6, abs=100)
    odometry, now_s = wait_for_message(make_autopilot(Channel.VISION, PX4), "ODOMETRY")
    assert odometry.time_usec == pytest.approx(now_s * 1e6, abs=100)


def test_navigation_restarts_if_our_clock_has_stood_still():
    autopilot, restarts = make_autopilot(Channel.GPS_INPUT), []
    autopilot.conversation.autopilot._listener.reset_navigation = lambda: restarts.append(autopilot.boot_s)
    for stood_s in (0.0, 6.0):
        autopilot.wait(1.0)
        assert not restarts
        autopilot.send(mavlink.MAVLink_attitude_message(autopilot.boot_ms + int(1e3 * stood_s), 0, 0, 0, 0, 0, 0))
    assert len(restarts) == 1


def test_gps_input_has_boot_time_and_utc_without_link_jitter():
    autopilot = make_autopilot(Channel.GPS_INPUT, lag_s=0.2)
    position, now_s = wait_for_message(autopilot, "GPS_INPUT")
    assert position.time_usec == pytest.approx((now_s - 600.2) * 1e6, abs=100)
    assert position.time_week == 0, "its UTC is not known yet"
    for late_s in (0.0, 0.3, 0.1):
        boot_ms, utc_us = autopilot.boot_ms, round((1_700_000_000 + autopilot.boot_s) * 1e6)
        autopilot.wait(late_s)
        autopilot.send(mavlink.MAVLink_system_time_message(utc_us, boot_ms))
        position, now_s = wait_for_message(autopilot, "GPS_INPUT")
        since_1980_s = position.time_week * 604_800 + position.time_week_ms / 1e3
        expected_s = 1_700_000_000 + (now_s - 600.2) - 315_964_800 + 18
        assert since_1980_s == pytest.approx(expected_s, abs=2.1e-3), f"{late_s} s late"


@pytest.mark.parametrize("channel", [Channel.COMMAND, Channel.GPS_INPUT, Channel.ODOMETRY])
def test_link_sends_no_timestamps_without_a_recent_time_from_the_autopilot(channel, caplog):
    name = {Channel.COMMAND: "COMMAND_INT", Channel.GPS_INPUT: "GPS_INPUT", Channel.ODOMETRY: "ODOMETRY"}[channel]
    autopilot = Autopilot(booted_s=600.0, timesync_s=None, listener=RecordingListener())
    sent_after_s, texts = [], []
    for step in range(80):
        autopilot.conversation.autopilot.selector._decision = Decision(ChannelChoice(channel, "for a test", 1))
        autopilot.conversation.autopilot.origin = 47.0, 8.0, 500.0
        autopilot.wait(0.1)
        autopilot.put_fix()
        for message in autopilot.take_sent():
            texts += [message.text] if message.get_type() == "STATUSTEXT" else []
            if message.get_type() == name:
                sent_after_s.append((step + 1) / 10)
                stamp_s = message.param1 if channel is Channel.COMMAND else message.time_usec / 1e6
                assert stamp_s == pytest.approx(autopilot.clock.now_s, abs=1e-3), "our own clock"
    assert sent_after_s[0] == pytest.approx(5.1, abs=0.15)
    assert caplog.text.count("TIMESYNC") == [("TIMESYNC" in text) for text in texts].count(True) == 1


def learn(*trips, start_s=1000.0):
    """A clock that has learnt by round trips a second apart, each (seconds to it, back); its boot was at 600 s."""
    clock = AutopilotClock(print)
    for number, (there_s, back_s) in enumerate(trips):
        sent_s = start_s + number
        request = clock.make_request(sent_s)
        boot_ns = round((sent_s + there_s - 600.0) * 1e9)
        assert not clock.handle(mavlink.MAVLink_timesync_message(boot_ns, request.ts1), sent_s + there_s + back_s)
    return clock


def test_boot_time_s_uses_the_shortest_round_trip_of_ten_seconds():
    slow, quick = (0.4, 0.01), (0.004, 0.002)
    assert learn(slow).boot_time_s(1000.0) == pytest.approx(400.195)
    assert learn(slow, quick, slow).boot_time_s(1000.0) == pytest.approx(400.001)
    assert learn(quick, *[slow] * 12).boot_time_s(1000.0) == pytest.approx(400.195)
    assert AutopilotClock(print).boot_time_s(1.0) is None


@pytest.mark.parametrize(("age_s", "counted_s"), [(0.2, 0.2), (1.1, 0.0), (-0.1, 0.0), (-1.7e9, 0.0)])
def test_report_of_a_receiver_counts_from_its_boot_time(age_s, counted_s):
    autopilot = make_autopilot(Channel.COMMAND)
    where = 500_000_000, 80_000_000, 300_000, 100, 100, 1000, 0, 10
    autopilot.send(mavlink.MAVLink_gps_raw_int_message(round(1e6 * (autopilot.boot_s - age_s)), 3, *where, h_acc=500))
    now_s = autopilot.clock.now_s
    report = autopilot.conversation.autopilot.receivers.choose_best(now_s)
    assert report.t_s == pytest.approx(now_s - counted_s, abs=0.01)
    assert AutopilotClock(print).mono_time_s(1.0, now_s) == now_s, "unknown"


def test_handle_ignores_an_unrequested_answer():
    clock = AutopilotClock(print)
    request = clock.make_request(1000.0)
    for tc1, ts1 in ((5 * 10**9, request.ts1 + 1), (0, request.ts1), (-5, request.ts1), (2**62, 0)):
        assert not clock.handle(mavlink.MAVLink_timesync_message(tc1, ts1), 1000.1)
    assert clock.boot_time_s(1000.0) is None
    autopilot = Autopilot(timesync_s=None)
    autopilot.send(mavlink.MAVLink_timesync_message(5 * 10**9, round(autopilot.clock.now_s * 1e9)), component_id=190)
    assert autopilot.conversation.autopilot.clock.boot_time_s(1000.0) is None, "answered by another component"


def test_handle_replaces_older_answers_that_a_new_one_contradicts():
    """As after a pause of a simulated autopilot, or of our computer."""
    clock = learn((0.001, 0.001), (0.001, 0.001))
    assert not clock.handle(mavlink.MAVLink_timesync_message(round(401.5e9), clock.make_request(1002.0).ts1), 1002.2)
    assert clock.boot_time_s(1002.1) == pytest.approx(401.5)


@pytest.mark.parametrize(
    ("first_ms", "then_ms", "has_restarted"),
    [
        (400_000, 2_000, True),
        (400_000, 398_900, True),
        (400_000, 399_100, False),
        (3_000_000_000, 2_000, True),
        (WRAP_MS - 500, 500, False),
    ],
)
def test_handle_recognises_another_boot_by_a_decreasing_boot_time_except_at_its_wrap(first_ms, then_ms, has_restarted):
    clock = AutopilotClock(print)
    assert not clock.handle(mavlink.MAVLink_attitude_message(first_ms, 0, 0, 0, 0, 0, 0), 1000.0)
    assert not clock.handle(mavlink.MAVLink_system_time_message(0, then_ms), 1001.0), "each kind has its own"
    assert clock.handle(mavlink.MAVLink_attitude_message(then_ms, 0, 0, 0, 0, 0, 0), 1001.0) is has_restarted


def make_foreign_message(kind, stamp_s):
    time_us = round(stamp_s * 1e6)
    if kind == "LANDING_TARGET":
        return mavlink.MAVLink_landing_target_message(time_us, 0, 8, 0, 0, 0, 0, 0)
    if kind == "VISION_POSITION_ESTIMATE":
        return mavlink.MAVLink_vision_position_estimate_message(time_us, 0, 0, 0, 0, 0, 0)
    return mavlink.MAVLink_command_int_message(7, 1, 0, 43003, 0, 0, stamp_s, 0, 9, math.nan, 0, 0, math.nan)


@pytest.mark.parametrize("kind", ["LANDING_TARGET", "VISION_POSITION_ESTIMATE", "43003"])
def test_timestamps_of_others_in_another_time_base_are_reported_once(kind, caplog):
    autopilot = Autopilot(booted_s=600.0)
    autopilot.send(make_foreign_message(kind, autopilot.boot_s - 0.4), component_id=191)
    autopilot.send(make_foreign_message(kind, 1.7e9), component_id=1)
    assert autopilot.texts() == []
    for _ in range(3):
        autopilot.send(make_foreign_message(kind, 1.7e9), component_id=191)
    texts = [text for _, text in autopilot.texts()]
    assert [f": 7/191 {kind[:15]}" in text for text in texts] == [True], "a long name is truncated"
    assert caplog.text.count("7/191") == 1
    px4 = Autopilot(PX4)
    px4.send(make_foreign_message(kind, 1.7e9), component_id=191)
    assert px4.texts() == [], "which converts each sender's own clock"


def report_late(autopilot, late_s):
    """Let a second of reports come `late_s` seconds after they were sent. Returns the texts to the ground station."""
    for _ in range(10):
        autopilot.beat()
        boot_ms = autopilot.boot_ms
        autopilot.wait(late_s)
        autopilot.send(mavlink.MAVLink_global_position_int_message(boot_ms, 500_000_000, 80_000_000, 0, 0, 0, 0, 0, 0))
        autopilot.send(mavlink.MAVLink_attitude_message(boot_ms, 0.5, 0, 0, 0, 0, 0))
        autopilot.wait(0.1)
    return [message.text for message in autopilot.take_sent() if message.get_type() == "STATUSTEXT"]


@pytest.mark.parametrize("is_the_way_back", [True, False])
def test_delay_s_keeps_reports_of_a_full_link_from_being_used(is_the_way_back):
    autopilot = Autopilot(booted_s=600.0)
    texts = report_late(autopilot, 0.05)
    before = autopilot.vehicle
    assert before is not None
    assert not texts
    if not is_the_way_back:
        autopilot.timesync_s = 1.5
    texts = [text for _ in range(4) for text in report_late(autopilot, 1.2 if is_the_way_back else 0.0)]
    assert autopilot.vehicle.t_received_s - before.t_received_s < 2.0, "the vehicle is where it was last heard in time"
    assert autopilot.conversation.predict_vehicle(autopilot.clock.now_s).roll_deg is None
    assert any(text.endswith(" s late") for text in texts)
    autopilot.timesync_s = 0.0
    texts = [text for _ in range(12) for text in report_late(autopilot, 0.05)]
    assert autopilot.clock.now_s - autopilot.vehicle.t_received_s < 0.2
    assert "on time" in texts[-1]


class LinkOfArduPilot:
    """ArduPilot's one time correction for all senders of a link, by the rules of its JitterCorrection: a stamp is never
    of the future, and never older than 0.5 s."""

    def __init__(self):
        self.offset_s, self.diffs_s = None, []

    def correct(self, stamp_s, now_s):
        """Return when a message with this stamp was sent, in the time since boot."""
        diff_s = now_s - stamp_s
        self.offset_s = diff_s if self.offset_s is None else min(diff_s, self.offset_s)
        sent_s = stamp_s + self.offset_s
        if sent_s + 0.5 < now_s:
            sent_s = now_s - 0.5
            self.offset_s = sent_s - stamp_s
        self.diffs_s.append(diff_s)
        if len(self.diffs_s) == 100:
            self.offset_s = min(self.diffs_s)
            self.diffs_s.clear()
        return sent_s


@pytest.mark.parametrize("age_s", [0.0, 0.3, 1.2])
@pytest.mark.parametrize("foreign_s", [None, 1.7e9])
def test_put_back_sends_ardupilot_the_position_at_its_assumed_delay(age_s, foreign_s):
    """The vehicle flies north at 20 m/s; what counts is where a fix lies beside the vehicle at the time of the fix."""
    autopilot, link = make_autopilot(Channel.COMMAND), LinkOfArduPilot()
    north_deg = 20.0 / 111_195
    for _ in range(5):
        autopilot.wait(0.5)
        autopilot.position(50.0 + north_deg * autopilot.boot_s, vx=2000)
        if foreign_s:
            autopilot.send(make_foreign_message("LANDING_TARGET", foreign_s), component_id=191)
            link.correct(foreign_s, autopilot.boot_s)
        frame_s = autopilot.boot_s - age_s
        fix = Fix(50.0 + north_deg * frame_s, 8.0, 5.0, autopilot.clock.now_s - age_s)
        autopilot.conversation.fixes.put(fix, autopilot.clock.now_s)
        (sent,) = [message for message in autopilot.take_sent() if message.get_type() == "COMMAND_INT"]
        counts_s = link.correct(sent.param1, autopilot.boot_s) - sent.param2
        assert (sent.x / 1e7 - 50.0) / north_deg == pytest.approx(counts_s, abs=0.02)
        autopilot.answer(0)
