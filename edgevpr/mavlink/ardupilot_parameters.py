"""The table of ArduPilot's parameters (see `parameters`). Each row names the file of ArduPilot 4.7-dev that decides."""

from collections.abc import Iterator

from edgevpr.mavlink.ardupilot_receivers import RECEIVER_RULES
from edgevpr.mavlink.channel import RECEIVERS, VISION, Channel, Choice
from edgevpr.mavlink.parameters import (
    MAX_DELAY_MS,
    MAX_OFFSET_M,
    FindChanges,
    ParameterRule,
    Parameters,
    demand,
    has_bit,
    name_axes,
)

_ALL = (Channel.COMMAND, Channel.GPS_INPUT, Channel.ODOMETRY)
_BY_GPS, _BY_ODOMETRY = (Channel.GPS_INPUT,), (Channel.ODOMETRY,)
_CONTINUOUS = _BY_GPS + _BY_ODOMETRY

_SET_PER_LANE = 8  # bit of EK3_SRC_OPTIONS
_GPS_CHECK, _VISION_CHECK, _ALL_CHECKS = 1 << 3, 1 << 18, 1  # bits of ARMING_CHECK
_FROM_GPS, _FROM_VISION, _FROM_GPS_VELOCITY = 3, 6, 8  # values of EK3_SRCn_...
_BARO, _COMPASS = 1, 1
_MAX_GLITCH_RADIUS_M = 100
_MAX_VISION_SD_M = 10
_SOURCE_SETS = (1, 2, 3)
# Set 2 for ODOMETRY: position by us, height and heading by the autopilot's own sensors.
VISION_SET = tuple(f"EK3_SRC2_{what}={value}" for what, value in (("POSXY", 6), ("VELXY", 0), ("POSZ", 1), ("YAW", 1)))


def _name_sources(what: str) -> tuple[str, ...]:
    return tuple(f"EK3_SRC{number}_{what}" for number in _SOURCE_SETS)


def _refuse_source(what: str, wrong: int, right: int) -> FindChanges:
    """Return a function that finds the source sets whose `what` is `wrong`, and advises `right`."""
    return demand(right, *_name_sources(what), allows=lambda source: source != wrong)


def _has_source(parameters: Parameters, source: int) -> bool:
    first, *others = _name_sources("POSXY")
    return parameters.get(first, _FROM_GPS) == source or source in map(parameters.get, others)


def _yield_set(parameters: Parameters, choice: Choice) -> Iterator[str]:
    """AP_NavEKF_Source.cpp: a source that no set has is never used."""
    if choice.channel is Channel.GPS_INPUT and not _has_source(parameters, _FROM_GPS):
        yield f"EK3_SRC1_POSXY={_FROM_GPS}"
    if choice.channel is Channel.ODOMETRY and not _has_source(parameters, _FROM_VISION):
        yield from VISION_SET


def _yield_set_per_lane(parameters: Parameters, _choice: Choice) -> Iterator[str]:
    """AP_NavEKF_Source.h, getActiveSourceSet: lane n uses set n, whatever the pilot selects."""
    options = parameters.get("EK3_SRC_OPTIONS", 0)
    is_mixed = _has_source(parameters, _FROM_GPS) and _has_source(parameters, _FROM_VISION)
    if has_bit(options, _SET_PER_LANE) and is_mixed:
        yield f"EK3_SRC_OPTIONS={int(options) & ~_SET_PER_LANE}"


def _yield_checks(parameters: Parameters, choice: Choice) -> Iterator[str]:
    """AP_Arming.cpp, check_enabled."""
    bit = _GPS_CHECK if choice.channel is Channel.GPS_INPUT else _VISION_CHECK
    checks, skipped = parameters.get("ARMING_CHECK", _ALL_CHECKS), parameters.get("ARMING_SKIPCHK", 0)
    if not has_bit(checks, _ALL_CHECKS | bit):
        yield f"ARMING_CHECK={_ALL_CHECKS}"
    if has_bit(skipped, bit):
        yield "ARMING_SKIPCHK=0"


_FILTER_RULES = (
    ParameterRule(
        label="AHRS_EKF_TYPE",
        names=("AHRS_EKF_TYPE", "EK3_ENABLE"),
        channels=_ALL,
        right="AHRS_EKF_TYPE 3, EK3_ENABLE 1",
        is_dangerous=False,
        # AP_AHRS.cpp, handle_external_position_estimate.
        why="Only the third EKF takes our positions: use it, and reboot.",
        find_changes=lambda parameters, choice: (
            *demand(1, "EK3_ENABLE")(parameters, choice),
            *demand(3, "AHRS_EKF_TYPE")(parameters, choice),
        ),
    ),
    ParameterRule(
        label="EK3_SRCn_POSXY",
        names=_name_sources("POSXY"),
        channels=_CONTINUOUS,
        right="3 in one set for GPS_INPUT; 6 in one set for ODOMETRY",
        is_dangerous=False,
        why="No source set of the filter takes our position.",
        find_changes=_yield_set,
    ),
    ParameterRule(
        label="EK3_SRCn_POSZ",
        names=_name_sources("POSZ"),
        channels=_BY_GPS,
        right="not 3",
        is_dangerous=True,
        # AP_NavEKF3_PosVelFusion.cpp, selectHeightForFusion.
        why="The height would come from our receiver, and that is the autopilot's own height.",
        find_changes=_refuse_source("POSZ", _FROM_GPS, right=_BARO),
    ),
    ParameterRule(
        label="EK3_SRCn_YAW",
        names=_name_sources("YAW"),
        channels=_BY_GPS,
        right="not 8",
        is_dangerous=True,
        # EKFGSF_yaw.cpp: the heading for which accelerations fit the receiver's velocity.
        why="The heading would come from our velocity, and that is computed with the autopilot's own heading.",
        find_changes=_refuse_source("YAW", _FROM_GPS_VELOCITY, right=_COMPASS),
    ),
    ParameterRule(
        label="EK3_GLITCH_RAD",
        names=("EK3_GLITCH_RAD",),
        channels=_CONTINUOUS,
        right=f"above 0, up to {_MAX_GLITCH_RADIUS_M}",
        is_dangerous=False,
        # AP_NavEKF3_PosVelFusion.cpp, SelectVelPosFusion.
        why="With 0 the filter refuses no position, not even a wrong one; with more it comes back to a right one late.",
        find_changes=demand(25, "EK3_GLITCH_RAD", allows=lambda radius_m: 0 < radius_m <= _MAX_GLITCH_RADIUS_M),
    ),
    ParameterRule(
        label="ARMING_CHECK",
        names=("ARMING_CHECK",),
        channels=_CONTINUOUS,
        right="1, or with the bits 8 (GPS) and 262144 (vision); ARMING_SKIPCHK in newer firmware: without them",
        is_dangerous=False,
        why="It arms although our positions do not come, or contradict GPS.",
        find_changes=_yield_checks,
    ),
)
_ODOMETRY_RULES = (
    ParameterRule(
        label="EK3_SRCn_VELXY",
        names=_name_sources("VELXY"),
        channels=_BY_ODOMETRY,
        right="not 6",
        is_dangerous=True,
        # AP_VisualOdom_MAV.cpp: VISO_VEL_M_NSE is the accuracy, whatever we send.
        why="Our velocity comes from the same matches as the position; the filter would trust it more than its gyros.",
        find_changes=_refuse_source("VELXY", _FROM_VISION, right=0),
    ),
    ParameterRule(
        label="EK3_SRCn_*",
        names=tuple(name for what in ("POSZ", "VELZ", "YAW") for name in _name_sources(what)),
        channels=_BY_ODOMETRY,
        right="POSZ, VELZ and YAW not 6",
        is_dangerous=True,
        why="Height, climb and heading in our ODOMETRY are the autopilot's own: it would measure itself.",
        find_changes=lambda parameters, choice: (
            *_refuse_source("POSZ", _FROM_VISION, right=_BARO)(parameters, choice),
            *_refuse_source("VELZ", _FROM_VISION, right=0)(parameters, choice),
            *_refuse_source("YAW", _FROM_VISION, right=_COMPASS)(parameters, choice),
        ),
    ),
    ParameterRule(
        label="EK3_SRC_OPTIONS",
        names=("EK3_SRC_OPTIONS", *_name_sources("POSXY")),
        channels=_BY_ODOMETRY,
        right="without the bit 8, where one set has GPS and one has us",
        is_dangerous=True,
        why="Each lane of the filter has its own source set, so one flies by us while GPS is good.",
        find_changes=_yield_set_per_lane,
    ),
    ParameterRule(
        label="VISO_SCALE",
        names=("VISO_SCALE",),
        channels=_BY_ODOMETRY,
        right="1",
        is_dangerous=True,
        # AP_VisualOdom_MAV.cpp, handle_pose_estimate.
        why="It multiplies our distance from the origin.",
        find_changes=demand(1, "VISO_SCALE"),
    ),
    ParameterRule(
        label="VISO_ORIENT",
        names=("VISO_ORIENT",),
        channels=_BY_ODOMETRY,
        right="0",
        is_dangerous=False,
        # AP_VisualOdom_Backend.cpp turns VISION_POSITION_DELTA only, AP_VisualOdom_IntelT265.cpp all, but is not ours.
        why="Our positions must not be turned; 4.7 does not turn those of ODOMETRY, but that may change.",
        find_changes=demand(0, "VISO_ORIENT"),
    ),
    ParameterRule(
        label="VISO_POS_*",
        names=name_axes("VISO_POS"),
        channels=_BY_ODOMETRY,
        right=f"within {MAX_OFFSET_M:g} m of 0",
        is_dangerous=True,
        # AP_NavEKF3_PosVelFusion.cpp, CorrectExtNavForSensorOffset.
        why="We send the position of the vehicle itself, and a camera's place would move it.",
        find_changes=demand(0, *name_axes("VISO_POS"), allows=lambda offset_m: abs(offset_m) <= MAX_OFFSET_M),
    ),
    ParameterRule(
        label="VISO_DELAY_MS",
        names=("VISO_DELAY_MS",),
        channels=_BY_ODOMETRY,
        right=f"10, the default; up to {MAX_DELAY_MS:g}",
        is_dangerous=True,
        # AP_NavEKF3_Measurements.cpp, writeExtNavData.
        why="We send the position of the moment, and it would be taken for an old one.",
        find_changes=demand(10, "VISO_DELAY_MS", allows=lambda ms: ms <= MAX_DELAY_MS),
    ),
    ParameterRule(
        label="VISO_QUAL_MIN",
        names=("VISO_QUAL_MIN",),
        channels=_BY_ODOMETRY,
        right="0 to 100",
        is_dangerous=True,
        # AP_VisualOdom_MAV.cpp, handle_pose_estimate.
        why="With -1 even a position that we call bad is used.",
        find_changes=demand(0, "VISO_QUAL_MIN", allows=lambda quality: quality >= 0),
    ),
    ParameterRule(
        label="VISO_POS_M_NSE",
        names=("VISO_POS_M_NSE",),
        channels=_BY_ODOMETRY,
        right=f"up to {_MAX_VISION_SD_M}",
        is_dangerous=False,
        # AP_VisualOdom_MAV.cpp, handle_pose_estimate: the least standard deviation.
        why="A good position counts for no more than a poor one.",
        find_changes=demand(0.2, "VISO_POS_M_NSE", allows=lambda sd_m: sd_m <= _MAX_VISION_SD_M),
    ),
)
ARDUPILOT_RULES = RECEIVER_RULES + _FILTER_RULES + _ODOMETRY_RULES
ARDUPILOT_DECIDING = (*RECEIVERS, VISION)  # the parameters that decide which channel it is
