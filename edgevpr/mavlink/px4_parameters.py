"""The table of PX4's parameters (see `parameters`). Each row names the file of PX4 1.18.0-beta1 that decides, or what
was flown in its own simulator."""

from edgevpr.mavlink.channel import CONTROL, VISION_CONTROL, Channel
from edgevpr.mavlink.messages import SENSOR_ID
from edgevpr.mavlink.parameters import MAX_DELAY_MS, MAX_OFFSET_M, ParameterRule, demand, has_bit, name_axes

_ALL = (Channel.COMMAND, Channel.SENSOR, Channel.VISION)
_BY_296, _BY_ODOMETRY = (Channel.SENSOR,), (Channel.VISION,)

_USES_POSITION = 1  # bit of EKF2_GPS_CTRL
_FROM_VISION = 3  # value of EKF2_HGT_REF
_MAX_SD_M = 10  # the least error that the filter takes a position to have
_MAX_GATE_SD = 10

_GPS_RULES = (
    ParameterRule(
        label="EKF2_GPS_CTRL",
        names=("EKF2_GPS_CTRL",),
        channels=_ALL,
        right="7, the default: with the bit 1",
        is_dangerous=False,
        # gps_control.cpp, controlGnssPosFusion.
        why="GPS is not used for the position: it flies by us alone. That is for an aircraft without GPS only.",
        find_changes=demand(7, "EKF2_GPS_CTRL", allows=lambda value: has_bit(value, _USES_POSITION)),
    ),
    ParameterRule(
        label="EKF2_GPS_MODE",
        names=("EKF2_GPS_MODE",),
        channels=_ALL,
        right="0",
        is_dangerous=True,
        # gps_control.cpp, isGnssPosResetAllowed.
        why="GPS that comes back far from our position is refused for as long as airspeed or optical flow is used.",
        find_changes=demand(0, "EKF2_GPS_MODE"),
    ),
    ParameterRule(
        label="EKF2_HGT_REF",
        names=("EKF2_HGT_REF",),
        channels=(Channel.SENSOR, Channel.VISION),
        right="0 or 1",
        is_dangerous=False,
        why="We send no height: with 3 (vision) it never gets ready to arm.",  # flown
        find_changes=demand(1, "EKF2_HGT_REF", allows=lambda value: value != _FROM_VISION),
    ),
    ParameterRule(
        label="SYS_HAS_GPS",
        names=("SYS_HAS_GPS",),
        channels=_ALL,
        right="1",
        is_dangerous=False,
        why="With 0 it arms without GPS, so that the start may be unknown. That is for an aircraft without GPS only.",
        find_changes=demand(1, "SYS_HAS_GPS"),
    ),
)
_RULES_OF_296 = (
    ParameterRule(
        label="EKF2_AGP0_ID",
        names=("EKF2_AGP0_ID",),
        channels=_BY_296,
        right=f"{SENSOR_ID}",
        is_dangerous=False,
        # aux_global_position.cpp: a slot whose number is 0 at the start does not exist.
        why="It is the number that our positions carry; with another they are not used.",
        find_changes=demand(SENSOR_ID, "EKF2_AGP0_ID"),
    ),
    ParameterRule(
        label="EKF2_AGP0_NOISE",
        names=("EKF2_AGP0_NOISE",),
        channels=_BY_296,
        right=f"1, the default; up to {_MAX_SD_M}",
        is_dangerous=True,
        why="It hardly follows us, and takes positions that are far off: with 50 it was 20 m off, and all seemed well.",
        find_changes=demand(1, "EKF2_AGP0_NOISE", allows=lambda sd_m: sd_m <= _MAX_SD_M),
    ),
    ParameterRule(
        label="EKF2_AGP0_GATE",
        names=("EKF2_AGP0_GATE",),
        channels=_BY_296,
        right=f"3, the default; up to {_MAX_GATE_SD}",
        is_dangerous=True,
        # aux_global_position_control.cpp: the gate of fuseHorizontalPosition.
        why="The filter refuses no position, not even a wrong one.",
        find_changes=demand(3, "EKF2_AGP0_GATE", allows=lambda gate_sd: gate_sd <= _MAX_GATE_SD),
    ),
    ParameterRule(
        label="EKF2_AGP0_MODE",
        names=("EKF2_AGP0_MODE",),
        channels=_BY_296,
        right="0",
        is_dangerous=False,
        # aux_global_position_control.cpp, isResetAllowed.
        why="With airspeed or optical flow it never comes back to us, once it has left the gate.",
        find_changes=demand(0, "EKF2_AGP0_MODE"),
    ),
    ParameterRule(
        label="EKF2_AGP0_DELAY",
        names=("EKF2_AGP0_DELAY",),
        channels=_BY_296,
        right=f"0; up to {MAX_DELAY_MS:g}",
        is_dangerous=True,
        # aux_global_position_control.cpp, bufferData.
        why="We send the position of the moment, and it would be taken for an old one.",
        find_changes=demand(0, "EKF2_AGP0_DELAY", allows=lambda ms: ms <= MAX_DELAY_MS),
    ),
)
_RULES_OF_ODOMETRY = (
    ParameterRule(
        label="EKF2_EV_NOISE_MD",
        names=("EKF2_EV_NOISE_MD",),
        channels=_BY_ODOMETRY,
        right="0",
        is_dangerous=True,
        # params_external_vision.yaml.
        why="With 1 each position is taken to be good to EKF2_EVP_NOISE (0.1 m), whatever we send.",
        find_changes=demand(0, "EKF2_EV_NOISE_MD"),
    ),
    ParameterRule(
        label="EKF2_EVP_NOISE",
        names=("EKF2_EVP_NOISE",),
        channels=_BY_ODOMETRY,
        right=f"0.1, the default; up to {_MAX_SD_M}",
        is_dangerous=True,
        why="It hardly follows us, and takes positions that are far off: with 20 it was 35 m off, and landed.",  # flown
        find_changes=demand(0.1, "EKF2_EVP_NOISE", allows=lambda sd_m: sd_m <= _MAX_SD_M),
    ),
    ParameterRule(
        label="EKF2_EVP_GATE",
        names=("EKF2_EVP_GATE",),
        channels=_BY_ODOMETRY,
        right=f"5, the default; up to {_MAX_GATE_SD}",
        is_dangerous=True,
        # ev_pos_control.cpp, controlEvPosFusion.
        why="The filter refuses no position, not even a wrong one.",
        find_changes=demand(5, "EKF2_EVP_GATE", allows=lambda gate_sd: gate_sd <= _MAX_GATE_SD),
    ),
    ParameterRule(
        label="EKF2_EV_POS_*",
        names=name_axes("EKF2_EV_POS"),
        channels=_BY_ODOMETRY,
        right=f"within {MAX_OFFSET_M:g} m of 0",
        is_dangerous=True,
        # ev_pos_control.cpp, pos_offset_body.
        why="We send the position of the vehicle itself, and a camera's place would move it.",
        find_changes=demand(0, *name_axes("EKF2_EV_POS"), allows=lambda offset_m: abs(offset_m) <= MAX_OFFSET_M),
    ),
    ParameterRule(
        label="EKF2_EV_DELAY",
        names=("EKF2_EV_DELAY",),
        channels=_BY_ODOMETRY,
        right=f"0; up to {MAX_DELAY_MS:g}",
        is_dangerous=True,
        why="We send the position of the moment, and it would be taken for an old one.",
        find_changes=demand(0, "EKF2_EV_DELAY", allows=lambda ms: ms <= MAX_DELAY_MS),
    ),
)
PX4_RULES = _GPS_RULES + _RULES_OF_296 + _RULES_OF_ODOMETRY
PX4_DECIDING = (CONTROL, VISION_CONTROL)  # the parameters that decide which channel it is
