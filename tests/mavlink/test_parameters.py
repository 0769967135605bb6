"""The table of parameters: what is right, what is dangerous, and what to change."""

import pytest
from simulated.firmware import ARDUPILOT, PX4

from edgevpr.core.reasons import ReasonCode
from edgevpr.mavlink.channel import OLD_NAMES, Channel, VehicleKind
from edgevpr.mavlink.channelselector import TABLES
from edgevpr.mavlink.wire import mavlink

ARDUPILOT_TABLE = TABLES[mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA]
PX4_TABLE = TABLES[mavlink.MAV_AUTOPILOT_PX4]
SECOND = ARDUPILOT | {"GPS2_TYPE": 14}  # a real receiver, and ours
FIRST = ARDUPILOT | {"GPS1_TYPE": 14, "GPS2_TYPE": 1}
ONLY = ARDUPILOT | {"GPS1_TYPE": 14}
ODOMETRY = ARDUPILOT | {"VISO_TYPE": 1, "EK3_SRC2_POSXY": 6}
SENSOR = PX4
VISION = PX4 | {"EKF2_AGP0_CTRL": 0, "EKF2_EV_CTRL": 1}


def decide(parameters, kind=VehicleKind.COPTER):
    table = ARDUPILOT_TABLE if "VISO_TYPE" in parameters else PX4_TABLE
    return table.decide(kind, parameters, lambda name: True)


@pytest.mark.parametrize(
    ("parameters", "channel"),
    [
        (ARDUPILOT, Channel.COMMAND),
        (SECOND, Channel.GPS_INPUT),
        (FIRST, Channel.GPS_INPUT),
        (ONLY, Channel.GPS_INPUT),
        (ODOMETRY, Channel.ODOMETRY),
        (ODOMETRY | {"EK3_SRC1_POSXY": 6, "GPS1_TYPE": 0}, Channel.ODOMETRY),
        (SENSOR, Channel.SENSOR),
        (VISION, Channel.VISION),
        (VISION | {"EKF2_AGP0_CTRL": 1}, Channel.SENSOR),
        (PX4 | {"EKF2_AGP0_CTRL": 0}, Channel.COMMAND),
    ],
)
def test_decide_finds_no_fault_in_defaults(parameters, channel):
    decision = decide(parameters)
    assert (decision.choice.channel, decision.faults) == (channel, ())


DANGEROUS = [
    (SECOND, {"GPS_PRIMARY": 1, "GPS_AUTO_SWITCH": 4}, "GPS_PRIMARY=0"),
    (SECOND, {"GPS_PRIMARY": 1, "GPS_AUTO_SWITCH": 0}, "GPS_PRIMARY=0 and GPS_AUTO_SWITCH=1"),
    (FIRST, {"GPS_AUTO_SWITCH": 4}, "GPS_PRIMARY=1"),
    (SECOND, {"GPS_AUTO_SWITCH": 2, "GPS_BLEND_MASK": 4}, "GPS_AUTO_SWITCH=1"),
    (SECOND, {"GPS_AUTO_SWITCH": 2, "GPS_BLEND_MASK": 7}, "GPS_AUTO_SWITCH=1"),
    (SECOND, {"EK3_AFFINITY": 5}, "EK3_AFFINITY=4"),
    (SECOND, {"GPS2_DELAY_MS": 400}, "GPS2_DELAY_MS=0"),
    (SECOND, {"GPS2_POS_X": 3.0, "GPS2_POS_Z": -2.0}, "GPS2_POS_X=0 and GPS2_POS_Z=0"),
    (SECOND, {"AHRS_GPS_USE": 2}, "AHRS_GPS_USE=1"),
    (SECOND, {"EK3_SRC1_POSZ": 3}, "EK3_SRC1_POSZ=1"),
    (SECOND, {"EK3_SRC3_POSZ": 3}, "EK3_SRC3_POSZ=1"),
    (SECOND, {"EK3_SRC1_YAW": 8}, "EK3_SRC1_YAW=1"),
    (ODOMETRY, {"EK3_SRC2_VELXY": 6}, "EK3_SRC2_VELXY=0"),
    (ODOMETRY, {"EK3_SRC3_VELXY": 6}, "EK3_SRC3_VELXY=0"),
    (ODOMETRY, {"EK3_SRC2_POSZ": 6}, "EK3_SRC2_POSZ=1"),
    (ODOMETRY, {"EK3_SRC2_VELZ": 6, "EK3_SRC2_YAW": 6}, "EK3_SRC2_VELZ=0 and EK3_SRC2_YAW=1"),
    (ODOMETRY, {"EK3_SRC_OPTIONS": 9}, "EK3_SRC_OPTIONS=1"),
    (ODOMETRY, {"VISO_SCALE": 1.2}, "VISO_SCALE=1"),
    (ODOMETRY, {"VISO_POS_Y": -4.0}, "VISO_POS_Y=0"),
    (ODOMETRY, {"VISO_DELAY_MS": 250}, "VISO_DELAY_MS=10"),
    (ODOMETRY, {"VISO_QUAL_MIN": -1}, "VISO_QUAL_MIN=0"),
    (SENSOR, {"EKF2_GPS_MODE": 1}, "EKF2_GPS_MODE=0"),
    (SENSOR, {"EKF2_GPS_CTRL": 3}, "EKF2_GPS_CTRL=7"),
    (SENSOR, {"EKF2_AGP0_NOISE": 50.0}, "EKF2_AGP0_NOISE=1"),
    (SENSOR, {"EKF2_AGP0_GATE": 100.0}, "EKF2_AGP0_GATE=3"),
    (SENSOR, {"EKF2_AGP0_DELAY": 300.0}, "EKF2_AGP0_DELAY=0"),
    (VISION, {"EKF2_GPS_MODE": 1}, "EKF2_GPS_MODE=0"),
    (VISION, {"EKF2_EVP_NOISE": 20.0}, "EKF2_EVP_NOISE=0.1"),
    (VISION, {"EKF2_EVP_GATE": 100.0}, "EKF2_EVP_GATE=5"),
    (VISION, {"EKF2_EV_POS_X": 5.0}, "EKF2_EV_POS_X=0"),
    (VISION, {"EKF2_EV_DELAY": 300.0}, "EKF2_EV_DELAY=0"),
    (VISION, {"EKF2_EV_NOISE_MD": 1}, "EKF2_EV_NOISE_MD=0"),
]


@pytest.mark.parametrize(("parameters", "wrong", "advice"), DANGEROUS)
def test_decide_stops_the_channel_for_a_dangerous_parameter(parameters, wrong, advice):
    decision = decide(parameters | wrong)
    assert decision.choice.channel is Channel.NONE
    why = decision.choice.silence_reason
    assert (why.code, why.parameters["changes"]) == (ReasonCode.PARAMETER_DANGEROUS, advice)


WEAK = [
    (ARDUPILOT, {"AHRS_EKF_TYPE": 2}, "AHRS_EKF_TYPE=3"),
    (SECOND, {"EK3_ENABLE": 0}, "EK3_ENABLE=1"),
    (SECOND, {"GPS_AUTO_SWITCH": 0}, "GPS_AUTO_SWITCH=1"),
    (SECOND, {"GPS_AUTO_SWITCH": 2}, "GPS_AUTO_SWITCH=1"),
    (SECOND, {"EK3_SRC1_POSXY": 0}, "EK3_SRC1_POSXY=3"),
    (SECOND, {"EK3_GLITCH_RAD": 0}, "EK3_GLITCH_RAD=25"),
    (SECOND, {"ARMING_CHECK": 0}, "ARMING_CHECK=1"),
    (ODOMETRY, {"ARMING_CHECK": 8}, "ARMING_CHECK=1"),
    (ODOMETRY, {"ARMING_SKIPCHK": -1}, "ARMING_SKIPCHK=0"),
    (ODOMETRY, {"VISO_ORIENT": 4}, "VISO_ORIENT=0"),
    (ODOMETRY, {"VISO_POS_M_NSE": 50.0}, "VISO_POS_M_NSE=0.2"),
    (ODOMETRY, {"EK3_SRC2_POSXY": 0}, "EK3_SRC2_POSXY=6 and EK3_SRC2_VELXY=0 and EK3_SRC2_POSZ=1 and EK3_SRC2_YAW=1"),
    (SENSOR, {"EKF2_GPS_CTRL": 0}, "EKF2_GPS_CTRL=7"),
    (SENSOR, {"EKF2_GPS_CTRL": 4}, "EKF2_GPS_CTRL=7"),
    (SENSOR, {"EKF2_HGT_REF": 3}, "EKF2_HGT_REF=1"),
    (SENSOR, {"SYS_HAS_GPS": 0}, "SYS_HAS_GPS=1"),
    (SENSOR, {"EKF2_AGP0_ID": 0}, "EKF2_AGP0_ID=1"),
    (SENSOR, {"EKF2_AGP0_MODE": 1}, "EKF2_AGP0_MODE=0"),
]


@pytest.mark.parametrize(("parameters", "wrong", "advice"), WEAK)
def test_decide_reports_a_weak_parameter_and_keeps_the_channel(parameters, wrong, advice):
    decision = decide(parameters | wrong)
    assert decision.choice.channel is decide(parameters).choice.channel
    (why,) = (fault.reason for fault in decision.faults)
    assert (why.code, why.parameters["changes"]) == (ReasonCode.PARAMETER_WEAK, advice)


@pytest.mark.parametrize(
    ("parameters", "harmless"),
    [
        (SECOND, {"GPS_PRIMARY": 1}),  # a real receiver with a 3D fix outbids us
        (SECOND, {"GPS_AUTO_SWITCH": 4}),
        (SECOND, {"GPS1_POS_X": 3.0, "GPS1_DELAY_MS": 400}),  # the other receiver's
        (SECOND, {"GPS2_DELAY_MS": 100}),
        (SECOND, {"EK3_AFFINITY": 4, "EK3_PRIMARY": 1}),
        (SECOND, {"ARMING_CHECK": 8}),
        (FIRST, {"GPS_AUTO_SWITCH": 4, "GPS_PRIMARY": 1, "EK3_GLITCH_RAD": 50}),
        (ONLY, {"GPS_AUTO_SWITCH": 0, "EK3_AFFINITY": 1}),  # it has no other GPS
        (ODOMETRY, {"VISO_POS_X": 0.3, "VISO_DELAY_MS": 30, "EK3_SRC_OPTIONS": 1}),
        (ODOMETRY | {"EK3_SRC1_POSXY": 6}, {"EK3_SRC_OPTIONS": 8}),
        (SENSOR, {"EKF2_AGP0_CTRL": 3, "EKF2_EV_CTRL": 15, "EKF2_EVP_NOISE": 20.0, "EKF2_GPS_CTRL": 15}),
    ],
)
def test_decide_accepts_harmless_parameters(parameters, harmless):
    decision = decide(parameters | harmless)
    assert (decision.choice.channel, decision.faults) == (decide(parameters).choice.channel, ())


@pytest.mark.parametrize("table", TABLES.values(), ids=lambda table: table.name)
def test_parameter_rules_each_have_a_case(table):
    found = {fault.rule.label for before, wrong, _ in DANGEROUS + WEAK for fault in decide(before | wrong).faults}
    assert {rule.label for rule in table.rules} <= found


def test_parameter_faults_use_the_names_of_the_autopilot():
    old = {OLD_NAMES.get(name, name): value for name, value in SECOND.items()}
    assert decide(old).choice.channel is Channel.GPS_INPUT
    assert decide(old | {"GPS_POS2_X": 3.0}).faults[0].changes == ("GPS_POS2_X=0",)
    assert decide(old | {"GPS_DELAY_MS2": 300}).faults[0].changes == ("GPS_DELAY_MS2=0",)
