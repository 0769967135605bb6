"""Why an autopilot refuses a fix, or says nothing to it: by what is known of it at second 0."""

from dataclasses import replace

import pytest

from edgevpr.mavlink import vehicle as reasons
from edgevpr.mavlink.messages import TEXT_BYTES
from edgevpr.mavlink.vehicle import Readiness, Reason
from edgevpr.mavlink.wire import mavlink

AIRBORNE = Readiness(is_armed=True, gps_s=-60.0, origin_s=-1.0, flags_s=0.0)
NO_ORIGIN = {"origin_s": -100.0, "asked_s": -3.0}
EMPTY = Readiness()
CONST, UNINITIALIZED = {"flags": mavlink.EKF_CONST_POS_MODE}, {"flags": mavlink.EKF_UNINITIALIZED}


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        (EMPTY, reasons.UNKNOWN),
        (Readiness(gps_s=0.0), reasons.GPS_IN_USE),
        (Readiness(gps_s=-2.5, is_armed=False), reasons.GPS_IN_USE),
        (Readiness(gps_s=-2.6), reasons.UNKNOWN),
        (AIRBORNE, reasons.UNKNOWN),
        (replace(AIRBORNE, gps_s=-1.0), reasons.GPS_IN_USE),
        (replace(AIRBORNE, is_armed=False, **NO_ORIGIN), reasons.NO_ORIGIN),
        (replace(AIRBORNE, is_armed=False), reasons.NOT_ARMED),
        (replace(AIRBORNE, is_armed=False, **CONST), reasons.NOT_ARMED),
        (replace(AIRBORNE, **CONST), reasons.NOT_RECKONING),
        (replace(AIRBORNE, flags_s=-4.0, **CONST), reasons.UNKNOWN),
        (replace(AIRBORNE, is_armed=None, **CONST), reasons.NOT_RECKONING),
        (replace(AIRBORNE, gps_s=0.0, **UNINITIALIZED), reasons.NOT_STARTED),
        (replace(AIRBORNE, **NO_ORIGIN, **UNINITIALIZED), reasons.NO_ORIGIN),
        (replace(AIRBORNE, gps_s=0.0, **NO_ORIGIN), reasons.GPS_IN_USE),
        (replace(AIRBORNE, is_px4=True, **UNINITIALIZED), reasons.NOT_PLAUSIBLE),
        (Readiness(is_px4=True, **NO_ORIGIN), reasons.NO_ORIGIN),
    ],
)
def test_a_failed_fix_has_the_first_reason_that_is_known_to_be_there(state, reason):
    assert state.why("FAILED", 0.0) == reason


@pytest.mark.parametrize(
    ("result", "state", "reason"),
    [
        ("ACCEPTED", EMPTY, reasons.TAKEN),
        ("DENIED", Readiness(gps_s=0.0), reasons.WRONG_FORM),
        ("UNSUPPORTED", EMPTY, reasons.NO_COMMAND),
        ("TEMPORARILY_REJECTED", Readiness(is_px4=True, gps_s=0.0), reasons.GPS_IN_USE),
        ("TEMPORARILY_REJECTED", Readiness(is_px4=True, gps_s=-9.0), reasons.OTHER_AID),
        ("TEMPORARILY_REJECTED", EMPTY, reasons.UNKNOWN),
        ("99", EMPTY, Reason("see its log", "it answers 99")),
    ],
)
def test_every_answer_has_its_reason(result, state, reason):
    assert state.why(result, 0.0) == reason


def test_every_reason_fits_a_status_text():
    known = [each for each in vars(reasons).values() if isinstance(each, Reason)]
    assert len(known) > 10
    assert all(len(f"edgevpr: fixes unanswered: {each.brief}".encode()) <= TEXT_BYTES for each in known)
