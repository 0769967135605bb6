"""Requests for an autopilot's parameters in flight, and the effect of late, lost and changed answers."""

import random
from collections import Counter
from itertools import pairwise

import pytest
from scripted_autopilot import Autopilot
from simulated.firmware import ARDUPILOT, PX4

from edgevpr.core.reasons import ReasonCode
from edgevpr.mavlink.channel import OLD_NAMES, Channel
from edgevpr.mavlink.messages import Fix, Severity
from edgevpr.mavlink.wire import mavlink

COPTER = ARDUPILOT | {"GPS2_TYPE": 14}
STEP_S = 0.1


class ParamPilot(Autopilot):
    """An autopilot that is asked where it is, and notes which parameters, when."""

    def __init__(self, parameters, firmware=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, **link):
        super().__init__(firmware)
        self.parameters, self.link = dict(parameters), link
        self.requests, self.sent, self.begin_s = [], [], self.clock.now_s
        self.conversation.request_position()

    def answer_for(self, seconds, channel=None):
        """Answer for so long, or until the channel is this one; returns for how long it took."""
        start_s = self.clock.now_s
        while self.clock.now_s - start_s < seconds - STEP_S / 2:
            self.wait(STEP_S)
            self.beat()
            for message in self.reply(self.parameters, **self.link):
                if message.get_type() == "PARAM_REQUEST_READ":
                    self.requests.append((self.clock.now_s, message.param_id))
                self.sent.append(message)
            if channel and self.conversation.channel is channel:
                break
        return self.clock.now_s - start_s

    def set(self, **parameters):
        """Set parameters, and broadcast them as autopilots do."""
        self.parameters |= parameters
        for name, value in parameters.items():
            self.send(self.parameter(name, value))

    def sentences(self):
        sent, self.sent = self.sent, []
        return [(each.severity, each.text) for each in sent if each.get_type() == "STATUSTEXT"]

    @property
    def selector(self):
        return self.conversation.autopilot.selector


def lose(share, seed=1):
    dice = random.Random(seed)
    return lambda message: dice.random() < share


def test_selector_requests_end_once_all_parameters_are_known():
    autopilot = ParamPilot(COPTER)
    assert autopilot.answer_for(10, Channel.GPS_INPUT) < 5
    autopilot.answer_for(10)
    known = {message.param_id for message in autopilot.sent if message.get_type() == "PARAM_REQUEST_READ"}
    assert {"GPS2_TYPE", "VISO_SCALE", "EK3_SRC3_YAW"} < known
    assert not known.intersection(OLD_NAMES.values())


def test_selector_requests_at_most_ten_at_growing_intervals_without_answers():
    autopilot = ParamPilot(COPTER, is_lost=lambda message: True)
    autopilot.answer_for(300)
    count = Counter(t_s for t_s, _ in autopilot.requests)
    assert max(count.values()) <= 10
    assert {name for t_s, name in autopilot.requests if t_s == min(count)} > {"GPS1_TYPE", "GPS2_TYPE", "VISO_TYPE"}
    pauses = [round(after - before) for before, after in pairwise(sorted(count))]
    assert pauses[:8] == [1, 1, 1, 1, 2, 4, 8, 16]
    assert set(pauses[8:]) == {30}


def test_answers_after_eight_seconds_of_silence_choose_the_channel():
    autopilot = ParamPilot(COPTER)
    autopilot.link["is_lost"] = lambda message: autopilot.clock.now_s - autopilot.begin_s < 8
    autopilot.answer_for(8)
    assert autopilot.conversation.channel is Channel.NONE
    assert autopilot.answer_for(30, Channel.GPS_INPUT) < 10


@pytest.mark.parametrize("firmware", ["old", "without vision"])
def test_parameters_that_the_autopilot_lacks_are_absent_after_some_rounds(firmware):
    parameters = {name: value for name, value in COPTER.items() if not name.startswith("VISO")}
    if firmware == "old":
        parameters = {OLD_NAMES.get(name, name): value for name, value in parameters.items()}
    autopilot = ParamPilot(parameters)
    autopilot.answer_for(2)
    assert autopilot.conversation.channel is Channel.NONE, "VISO_TYPE may have been lost"
    assert autopilot.answer_for(30, Channel.GPS_INPUT) < 15


def test_selector_treats_a_nonexistent_parameter_as_absent_at_once():
    px4 = {name: value for name, value in PX4.items() if "AGP" not in name}
    assert ParamPilot(px4, mavlink.MAV_AUTOPILOT_PX4, errors=True).answer_for(10, Channel.COMMAND) < 2


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_selector_does_not_treat_a_parameter_with_lost_answers_as_absent(share):
    """What is asked for in vain is on a link that loses as much else no proof that it is not there."""
    for seed in range(5):
        autopilot = ParamPilot(COPTER | {"GPS_PRIMARY": 1, "GPS_AUTO_SWITCH": 4}, is_lost=lose(share, seed))
        autopilot.answer_for(40)
        assert autopilot.conversation.channel is Channel.NONE
        assert autopilot.selector.choice.reason.parameters["changes"] == "GPS_PRIMARY=0"
        assert not [message for message in autopilot.sent if message.get_type() == "GPS_INPUT"]


def test_selector_reports_missing_answers_once_and_withholds_fixes():
    autopilot = ParamPilot(COPTER, is_lost=lambda message: message.param_id not in ("GPS1_TYPE", "AHRS_EKF_TYPE"))
    autopilot.answer_for(1)
    autopilot.link["is_lost"] = lambda message: True
    autopilot.answer_for(30)
    ((severity, text),) = autopilot.sentences()
    assert (severity, "GPS2_TYPE" in text, "1 more" in text) == (Severity.WARNING, True, True)
    sending = autopilot.conversation.send_fix(Fix(50.0, 8.0, 9.0, autopilot.clock.now_s))
    autopilot.answer_for(1)
    assert (sending.sent, sending.why.code) == (False, ReasonCode.PARAMETERS_UNANSWERED)
    assert sending.why.parameters["names"] == "GPS2_TYPE, VISO_TYPE"
    autopilot.link = {}
    autopilot.answer_for(60, Channel.GPS_INPUT)
    autopilot.answer_for(10)
    texts = [(severity, text) for severity, text in autopilot.sentences() if "ignores" not in text]
    assert [severity for severity, text in texts if "GPS_INPUT" in text] == [Severity.INFO]


def test_selector_stops_the_channel_while_a_parameter_is_dangerous():
    autopilot = ParamPilot(COPTER)
    autopilot.answer_for(10)
    autopilot.set(GPS_PRIMARY=1)
    assert autopilot.conversation.channel is Channel.GPS_INPUT
    autopilot.set(GPS_AUTO_SWITCH=4)
    assert autopilot.conversation.channel is Channel.NONE
    autopilot.sent.clear()
    autopilot.answer_for(10)
    assert "GPS_INPUT" not in {message.get_type() for message in autopilot.sent}
    assert [level for level, text in autopilot.sentences() if "set GPS_PRIMARY=0" in text] == [Severity.WARNING]
    autopilot.set(GPS_PRIMARY=0)
    assert autopilot.conversation.channel is Channel.GPS_INPUT


def test_selector_notices_an_unannounced_change_within_two_minutes():
    autopilot = ParamPilot(COPTER)
    autopilot.answer_for(10)
    autopilot.parameters["EK3_AFFINITY"] = 1
    assert autopilot.answer_for(130, Channel.NONE) < 125
    autopilot.requests.clear()
    autopilot.answer_for(20)
    assert len(autopilot.requests) == pytest.approx(10, abs=1)


def test_selector_reports_a_weak_parameter_once():
    autopilot = ParamPilot(PX4 | {"EKF2_GPS_CTRL": 0}, mavlink.MAV_AUTOPILOT_PX4)
    autopilot.answer_for(120)
    assert autopilot.conversation.channel is Channel.SENSOR
    ((severity, text),) = autopilot.sentences()
    assert (severity, "EKF2_GPS_CTRL=7" in text) == (Severity.WARNING, True)


def test_selector_uses_the_command_at_once_with_unknown_firmware():
    autopilot = ParamPilot({}, mavlink.MAV_AUTOPILOT_GENERIC)
    autopilot.answer_for(60)
    assert autopilot.conversation.channel is Channel.COMMAND
    assert autopilot.requests == []
