"""Why an autopilot refuses a fix, from what is known of it: each cause, and which of them comes first."""

import pytest

from edgevpr.mavlink import readiness as reasons
from edgevpr.mavlink.messages import TEXT_BYTES
from edgevpr.mavlink.readiness import AutopilotState, Reason, why, why_silent
from edgevpr.mavlink.wire import mavlink

CONST, UNINITIALIZED = mavlink.EKF_CONST_POS_MODE, mavlink.EKF_UNINITIALIZED
AIRBORNE = AutopilotState(is_armed=True, gps_age_s=60.0, has_origin=True, filter_flags=0)


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        (AutopilotState(), reasons.UNKNOWN),
        (AutopilotState(gps_age_s=0.0), reasons.GPS_IN_USE),
        (AutopilotState(gps_age_s=2.5, is_armed=False), reasons.GPS_IN_USE),
        (AutopilotState(gps_age_s=2.6), reasons.UNKNOWN),
        (AIRBORNE, reasons.UNKNOWN),
        (AIRBORNE._replace(gps_age_s=1.0), reasons.GPS_IN_USE),
        (AIRBORNE._replace(has_origin=False, is_armed=False), reasons.NO_ORIGIN),
        (AIRBORNE._replace(is_armed=False), reasons.NOT_ARMED),
        (AIRBORNE._replace(is_armed=False, filter_flags=CONST), reasons.NOT_ARMED),
        (AIRBORNE._replace(filter_flags=CONST), reasons.NOT_RECKONING),
        (AIRBORNE._replace(is_armed=None, filter_flags=CONST), reasons.NOT_RECKONING),
        (AIRBORNE._replace(gps_age_s=0.0, filter_flags=UNINITIALIZED), reasons.NOT_STARTED),
        (AIRBORNE._replace(has_origin=False, filter_flags=UNINITIALIZED), reasons.NO_ORIGIN),
        (AIRBORNE._replace(gps_age_s=0.0, has_origin=False), reasons.GPS_IN_USE),
        (AIRBORNE._replace(is_px4=True, filter_flags=UNINITIALIZED), reasons.NOT_PLAUSIBLE),
        (AutopilotState(is_px4=True, has_origin=False), reasons.NO_ORIGIN),
    ],
)
def test_a_fix_failed_for_the_first_cause_that_is_known(state, reason):
    assert why("FAILED", state) == reason


@pytest.mark.parametrize(
    ("result", "state", "reason"),
    [
        ("ACCEPTED", AutopilotState(), reasons.TAKEN),
        ("DENIED", AutopilotState(gps_age_s=0.0), reasons.WRONG_FORM),
        ("UNSUPPORTED", AutopilotState(), reasons.NO_COMMAND),
        ("TEMPORARILY_REJECTED", AutopilotState(is_px4=True, gps_age_s=0.0), reasons.GPS_IN_USE),
        ("TEMPORARILY_REJECTED", AutopilotState(is_px4=True, gps_age_s=9.0), reasons.OTHER_AID),
        ("TEMPORARILY_REJECTED", AutopilotState(), reasons.UNKNOWN),
        ("99", AutopilotState(), Reason("see its log", "it answers 99")),
    ],
)
def test_every_answer_has_a_reason(result, state, reason):
    assert why(result, state) == reason


def test_silence_to_all_commands_is_another_matter_than_silence_to_fixes():
    assert "signed" in why_silent(AutopilotState()).sentence
    assert "43003" in why_silent(AutopilotState(answers_others=True)).sentence


def test_every_reason_fits_the_text_for_the_ground_station():
    known = [each for each in vars(reasons).values() if isinstance(each, Reason)]
    assert len(known) > 10
    for each in known:
        assert len(f"edgevpr: fixes refused: {each.brief}".encode()) <= TEXT_BYTES
