"""Which fix an answer belongs to, why one is refused, what becomes of those without one, and what is said of all."""

import logging
import math

import pytest
from scripted_autopilot import ARMED, FIX_3D

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.fixes import FixAnswer, Fixes, FixTransmission
from edgevpr.mavlink.messages import MAX_TEXT_BYTES, Fix
from edgevpr.mavlink.vehicle import Readiness
from edgevpr.mavlink.wire import mavlink

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
FAILED = mavlink.MAV_RESULT_FAILED
DENIED = mavlink.MAV_RESULT_DENIED
LATE = FixAnswer(None, Reason(ReasonCode.NO_ANSWER, {"limit_s": 1.0}), None)
UNANSWERED = Reason(ReasonCode.FIXES_UNANSWERED)
GPS_IN_USE = Reason(ReasonCode.GPS_IN_USE)
SILENT = Reason(ReasonCode.NO_COMMAND_ANSWERED)


@pytest.fixture
def fixes():
    return Fixes()


def send(fixes, *times_s):
    """Send a fix at each time; give the last."""
    for t_s in times_s:
        sending = FixTransmission(Fix(50.0, 8.0, 20.0, t_s), t_s + 1)
        fixes.record_sent(sending, t_s)
        sending.settle(True)
    return sending


def answer_fix(fixes, result, t_s):
    """Let an autopilot that has GPS answer."""
    return fixes.handle(result, Readiness(has_gps=True).explain(result), t_s)


def test_fixes_get_their_own_answers_at_one_a_second_despite_losses(fixes):
    sendings = []
    for t_s in range(10):
        sendings.append(send(fixes, t_s))
        if t_s not in (3, 4):
            answer_fix(fixes, "ACCEPTED" if t_s % 2 else "FAILED", t_s + 0.02)
    answers = [sending.answer for sending in sendings]
    assert answers == [None if t_s in (3, 4) else ("ACCEPTED" if t_s % 2 else "FAILED") for t_s in range(10)]
    assert sendings[3].outcome == sendings[4].outcome == LATE
    assert sendings[9].outcome == FixAnswer("ACCEPTED", None, pytest.approx(0.02))
    assert (fixes.unanswered, len(fixes), fixes.refusal) == (2, 0, GPS_IN_USE)


def test_fixes_ignore_late_and_extra_answers(fixes):
    first, second, third = (send(fixes, t_s) for t_s in (-3.0, -2.8, -2.6))
    assert answer_fix(fixes, "FAILED", -2.5) is first
    assert answer_fix(fixes, "ACCEPTED", -2.4) is second
    assert answer_fix(fixes, "ACCEPTED", -2.3) is third
    late = send(fixes, 0.0)
    assert answer_fix(fixes, "FAILED", 1.1) is None
    assert late.outcome == LATE
    new = send(fixes, 2.0)
    assert answer_fix(fixes, "FAILED", 2.1) is new
    assert answer_fix(fixes, "FAILED", 2.1) is None
    assert fixes.unanswered == 1


def test_fixes_may_affect_the_position_unless_refused(fixes):
    assert fixes.t_fix_s == -math.inf
    send(fixes, 10.0)
    assert fixes.t_fix_s == 10.0, "it may be taken before the answer comes"
    answer_fix(fixes, "FAILED", 10.1)
    assert fixes.t_fix_s == -math.inf
    send(fixes, 11.0)
    answer_fix(fixes, "ACCEPTED", 11.1)
    assert fixes.t_fix_s == 11.1
    send(fixes, 12.0)
    answer_fix(fixes, "DENIED", 12.1)
    assert fixes.t_fix_s == 11.1
    send(fixes, 13.0)
    fixes.expire_unanswered(14.1)
    assert fixes.t_fix_s == 13.0, "only the answer may have been lost"
    send(fixes, 15.0)
    fixes.cancel_awaited(Reason(ReasonCode.LINK_LOST_BEFORE_ANSWER))
    assert fixes.t_fix_s == 15.0


def test_fixes_lost_with_the_port_await_no_answer_and_end_no_stop():
    reports = []
    fixes = Fixes(announce=lambda *report: reports.append(report))
    send(fixes, 0, 1, 2, 3, 4)
    fixes.record_lost(3)
    assert fixes.find_objection(5.0) is None
    send(fixes, 5, 6, 7)
    fixes.report_silence(SILENT, 8.5)
    send(fixes, 17.5)
    fixes.record_lost(2)
    fixes.report_silence(SILENT, 20.0)
    assert fixes.find_objection(20.0) == UNANSWERED
    assert [(SILENT.code.summary in text, topic) for _, text, topic in reports] == [(True, "answers")]


def fly(autopilot, count, every_s=1.0):
    """Send a fix every so often to an autopilot that is there; give what became of each."""
    sendings = []
    for _ in range(count):
        autopilot.wait(every_s)
        autopilot.conversation.announce_changes()
        sendings.append(autopilot.put_fix())
    return sendings


def test_fixes_stop_after_five_unanswered_ones_and_probe_every_ten_seconds(autopilot):
    sendings = fly(autopilot, 40)
    assert [number for number, sending in enumerate(sendings) if sending.sent] == [0, 1, 2, 3, 4, 14, 24, 34]
    assert all(sending.why == UNANSWERED for sending in sendings if not sending.sent)
    assert (autopilot.conversation.sent["COMMAND_INT"], autopilot.conversation.fixes.withheld) == (8, 32)


def test_fixes_do_not_take_late_answers_for_those_to_a_new_fix(autopilot):
    last = fly(autopilot, 6)[4]
    autopilot.wait(0.1)
    autopilot.answer(ACCEPTED)
    (held,) = fly(autopilot, 1, every_s=0.4)
    assert (held.sent, held.why.code) == (False, ReasonCode.ANSWERS_RESUMED)
    for _ in range(4):
        autopilot.answer(DENIED)
    (new,) = fly(autopilot, 1, every_s=0.6)
    assert (new.sent, new.answer) == (True, None)
    assert last.outcome == LATE
    assert autopilot.conversation.fixes.unanswered == 5


def test_fixes_refused_report_the_reason_from_the_autopilot_state(autopilot):
    def refuse_fix(result=FAILED, after_s=1.0):
        autopilot.wait(after_s)
        autopilot.beat(ARMED)
        autopilot.conversation.announce_changes()
        sending = autopilot.put_fix(base_mode=ARMED)
        autopilot.wait(0.03)
        autopilot.answer(result)
        return sending.outcome

    autopilot.gps()
    assert refuse_fix() == FixAnswer("FAILED", GPS_IN_USE, pytest.approx(0.03))
    autopilot.wait(2)
    autopilot.gps(fix_type=1)
    assert refuse_fix().why.code is ReasonCode.NO_CAUSE
    (request,) = autopilot.questions()
    assert (request.command, request.param1) == (512, 49), "it is asked for its origin"
    codes = [refuse_fix(after_s=3.0).why.code] + [refuse_fix().why.code for _ in range(20)]
    assert set(codes) == {ReasonCode.NO_ORIGIN}, "while it is asked again, too"
    assert len(autopilot.questions()) == 2
    autopilot.send(mavlink.MAVLink_gps_global_origin_message(1, 1, 1))
    autopilot.filter(mavlink.EKF_CONST_POS_MODE)
    assert refuse_fix().why.code is ReasonCode.NO_ESTIMATE
    assert refuse_fix(ACCEPTED).why is None
    assert autopilot.conversation.autopilot.acks == {"FAILED": 24, "ACCEPTED": 1}
    assert autopilot.conversation.fixes.refusal.code is ReasonCode.NO_ESTIMATE


def test_fixes_announce_each_reason_once_and_the_next_acceptance(autopilot, caplog):
    caplog.set_level(logging.INFO, "edgevpr.mavlink")
    texts = []
    for result in (ACCEPTED, FAILED, FAILED, DENIED, ACCEPTED, ACCEPTED):
        autopilot.wait(5.0)  # the ground is told one thing in five seconds
        autopilot.gps(FIX_3D)
        autopilot.take_fix(result)
        texts += autopilot.texts()
    codes = ReasonCode.GPS_IN_USE, ReasonCode.WRONG_FORM, ReasonCode.FIX_ACCEPTED
    assert [severity for severity, _ in texts] == [6, 4, 6]
    assert all(code.summary in text for code, (_, text) in zip(codes, texts, strict=True))
    assert caplog.text.count("the autopilot's answer") == 4


def test_fixes_count_only_answers_of_our_autopilot_to_us(autopilot):
    autopilot.answer(mavlink.MAV_RESULT_IN_PROGRESS)
    autopilot.answer(99)
    autopilot.answer(ACCEPTED, command=400)
    autopilot.answer(ACCEPTED, to=191)
    ack = mavlink.MAVLink_command_ack_message(43003, ACCEPTED, target_system=7, target_component=197)
    autopilot.send(ack, system_id=9)
    assert autopilot.conversation.autopilot.acks == {"99": 1}


@pytest.mark.parametrize(
    ("answers_commands", "code"), [(False, ReasonCode.NO_COMMAND_ANSWERED), (True, ReasonCode.FIXES_NOT_ANSWERED)]
)
def test_fixes_unanswered_report_whether_other_commands_are_answered(autopilot, answers_commands, code):
    autopilot.answer(ACCEPTED, command=511, to=191)
    if answers_commands:
        autopilot.answer(ACCEPTED, command=511)
    fly(autopilot, 7)
    ((severity, text),) = autopilot.texts()
    assert (severity, text.endswith(f": {code.summary}")) == (4, True)


CONST = {"flags": mavlink.EKF_CONST_POS_MODE}
UNINITIALIZED = {"flags": mavlink.EKF_UNINITIALIZED}
REJECTED = "TEMPORARILY_REJECTED"


@pytest.mark.parametrize(
    ("result", "state", "code"),
    [
        ("FAILED", {}, ReasonCode.NO_CAUSE),
        ("FAILED", {"has_gps": True, "is_armed": False}, ReasonCode.GPS_IN_USE),
        ("FAILED", {"lacks_origin": True, "is_armed": False}, ReasonCode.NO_ORIGIN),
        ("FAILED", {"is_armed": False, **CONST}, ReasonCode.NOT_ARMED),
        ("FAILED", {"is_armed": True, **CONST}, ReasonCode.NO_ESTIMATE),
        ("FAILED", {"has_gps": True, **UNINITIALIZED}, ReasonCode.NOT_STARTED),
        ("FAILED", {"lacks_origin": True, **UNINITIALIZED}, ReasonCode.NO_ORIGIN),
        ("FAILED", {"lacks_origin": True, "has_gps": True}, ReasonCode.GPS_IN_USE),
        ("FAILED", {"is_px4": True, **UNINITIALIZED}, ReasonCode.NOT_PLAUSIBLE),
        ("FAILED", {"is_px4": True, "lacks_origin": True}, ReasonCode.NO_ORIGIN),
        ("ACCEPTED", {}, ReasonCode.FIX_ACCEPTED),
        ("DENIED", {"has_gps": True}, ReasonCode.WRONG_FORM),
        ("UNSUPPORTED", {}, ReasonCode.NO_COMMAND),
        (REJECTED, {"is_px4": True, "has_gps": True}, ReasonCode.GPS_IN_USE),
        (REJECTED, {"is_px4": True}, ReasonCode.OTHER_AID),
        (REJECTED, {}, ReasonCode.NO_CAUSE),
        ("99", {}, ReasonCode.OTHER_ANSWER),
    ],
)
def test_explain_returns_the_first_reason_that_applies(result, state, code):
    assert Readiness(**state).explain(result).code is code


def test_fix_answer_summaries_fit_a_status_text():
    codes = list(ReasonCode)
    answers = codes[codes.index(ReasonCode.FIX_ACCEPTED) : codes.index(ReasonCode.FIXES_NOT_ANSWERED) + 1]
    texts = []
    for code in answers:
        fixes = Fixes(announce=lambda _, text, topic: texts.append(f"edgevpr: {text}"))
        send(fixes, 0, 1, 2, 3, 4)
        fixes.report_silence(Reason(code), 8.0)
    assert len(texts) == len(answers) > 10
    assert max(len(text.encode()) for text in texts) <= MAX_TEXT_BYTES
