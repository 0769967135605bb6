"""ArduPilot's channel and the table of its parameters (see `parameters`). With GPS_INPUT edgevpr acts as a receiver,
but a real one with a fix must always take precedence. Each rule names the file of ArduPilot 4.7-dev it is based on."""

from collections.abc import Iterator

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.channel import Channel, ChannelChoice, Parameters, VehicleKind, read_value, resolve_name
from edgevpr.mavlink.parameters import (
    MAX_DELAY_MS,
    MAX_OFFSET_M,
    Check,
    ParameterTable,
    expect,
    has_bit,
    is_small_offset,
    join_checks,
    list_axes,
    make_limit,
    recommend,
    require,
)

MAVLINK_GPS = 14  # value of GPSn_TYPE: the receiver is simulated by GPS_INPUT
ADVISED_RECEIVER = 1  # index of the receiver that we advise users to assign to edgevpr
RECEIVERS = ("GPS1_TYPE", "GPS2_TYPE")
DELAYS = ("GPS1_DELAY_MS", "GPS2_DELAY_MS")
VISION = "VISO_TYPE"
_MAVLINK_VISION = 1
# Age that AP_GPS assumes for the positions of a receiver without a configured delay (GPS_Backend::get_lag).
_GPS_LAG_S = 0.2

_ALL_CHANNELS = (Channel.COMMAND, Channel.GPS_INPUT, Channel.ODOMETRY)
_GPS_INPUT = (Channel.GPS_INPUT,)
_ODOMETRY = (Channel.ODOMETRY,)
_CONTINUOUS = _GPS_INPUT + _ODOMETRY

# Values of GPS_AUTO_SWITCH.
_SWITCH_PRIMARY = 0
_SWITCH_BEST = 1
_SWITCH_BLEND = 2
_SWITCH_PRIMARY_IF_3D = 4
# Bits of GPS_BLEND_MASK, EK3_AFFINITY, EK3_SRC_OPTIONS and ARMING_CHECK.
_BLEND_POSITION_BIT = 1
_BLEND_HEIGHT_BIT = 2
_AFFINITY_GPS_BIT = 1
_SET_PER_LANE_BIT = 8
_ALL_CHECKS_BIT = 1
_GPS_CHECK_BIT = 1 << 3
_VISION_CHECK_BIT = 1 << 18
# Values of EK3_SRCn_...
_SOURCE_GPS = 3
_SOURCE_VISION = 6
_SOURCE_GSF = 8
_SOURCE_BARO = 1
_SOURCE_COMPASS = 1
_MAX_GPS_DELAY_MS = 250  # the maximum length of EKF3's buffer: AP_NavEKF3_core.cpp, setup_core
_MAX_GLITCH_RADIUS_M = 100
_MAX_VISION_SD_M = 10
# Source set 2 for ODOMETRY: position from edgevpr, height and heading from the autopilot's own sensors.
_VISION_SET_CHANGES = ("EK3_SRC2_POSXY=6", "EK3_SRC2_VELXY=0", "EK3_SRC2_POSZ=1", "EK3_SRC2_YAW=1")


def choose_ardupilot_channel(kind: VehicleKind, parameters: Parameters) -> ChannelChoice:
    """Choose the channel for an ArduPilot: GPS_INPUT or ODOMETRY if its parameters are set for it, else command 43003.
    `parameters`: the values by name, without parameters that the autopilot lacks.

    A plane without GPS dead-reckons for as long as it flies, and accepts a fix at any time (`NavEKF3_core::setLatLng`).
    Without GPS and optical flow, a copter lands within seconds and a rover stops, even if they receive single fixes."""
    for number in range(len(RECEIVERS)):
        name = resolve_name(parameters, RECEIVERS[number])
        if parameters.get(name) == MAVLINK_GPS:
            delay_ms = read_value(parameters, DELAYS[number], 0)
            lag_s = delay_ms / 1e3 if delay_ms > 0 else _GPS_LAG_S
            return ChannelChoice(Channel.GPS_INPUT, Reason(ReasonCode.BY_GPS_INPUT, {"parameter": name}), number, lag_s)
    if parameters.get(VISION) == _MAVLINK_VISION:
        sets = [n for n, name in enumerate(_name_sources("POSXY"), 1) if parameters.get(name) == _SOURCE_VISION]
        source_set = None if 1 in sets or not sets else sets[0]
        reason = Reason(ReasonCode.BY_ODOMETRY, {"parameter": VISION, "source_set": source_set})
        return ChannelChoice(Channel.ODOMETRY, reason)
    if kind is VehicleKind.PLANE:
        return ChannelChoice(Channel.COMMAND, Reason(ReasonCode.COMMAND_TO_PLANE))
    change = f"{resolve_name(parameters, RECEIVERS[ADVISED_RECEIVER])}={MAVLINK_GPS}"
    reason = Reason(ReasonCode.COMMAND_NEEDS_FLOW, {"vehicle": kind.value, "change": change})
    return ChannelChoice(Channel.COMMAND, reason)


def _has_other_receiver(parameters: Parameters, choice: ChannelChoice) -> bool:
    return read_value(parameters, RECEIVERS[1 - choice.receiver], 0) != 0


def _is_primary(parameters: Parameters, choice: ChannelChoice) -> bool:
    """Return True if our receiver is ArduPilot's primary one (AP_GPS::update_primary)."""
    is_second = parameters.get("GPS_PRIMARY") == 1 and read_value(parameters, RECEIVERS[1], 0) != 0
    return int(is_second) == choice.receiver


def _check_primary(parameters: Parameters, choice: ChannelChoice) -> Iterator[str]:
    """Yield the changes that make the real receiver the primary one (AP_GPS.cpp, update_primary)."""
    switch = parameters.get("GPS_AUTO_SWITCH", _SWITCH_BEST)
    is_ours = _is_primary(parameters, choice) and _has_other_receiver(parameters, choice)
    if switch in (_SWITCH_PRIMARY, _SWITCH_PRIMARY_IF_3D) and is_ours:
        yield f"GPS_PRIMARY={1 - choice.receiver}"
        if switch == _SWITCH_PRIMARY:
            yield f"GPS_AUTO_SWITCH={_SWITCH_BEST}"


def _check_switch(parameters: Parameters, choice: ChannelChoice) -> Iterator[str]:
    """Yield the change that lets ArduPilot switch to our receiver, without blending it (AP_GPS.cpp, update_primary)."""
    switch = parameters.get("GPS_AUTO_SWITCH", _SWITCH_BEST)
    is_right = switch in (_SWITCH_BEST, _SWITCH_PRIMARY_IF_3D)
    is_right |= switch == _SWITCH_PRIMARY and _is_primary(parameters, choice)
    if switch == _SWITCH_BLEND:  # a dangerous blend has its own rule
        is_right = not _has_other_receiver(parameters, choice) or any(_check_blend(parameters, choice))
    if not is_right:
        yield f"GPS_AUTO_SWITCH={_SWITCH_BEST}"


def _check_blend(parameters: Parameters, choice: ChannelChoice) -> Iterator[str]:
    """Yield the change needed if blending gives our receiver a large weight: the mean of one weight per bit of the mask
    (AP_GPS_Blended.cpp, _calc_weights). Our weight is about 0.01 for horizontal accuracy and 0.1 for speed, but a third
    to a half for height, because our height is the autopilot's own."""
    mask = parameters.get("GPS_BLEND_MASK", 5)
    is_safe = has_bit(mask, _BLEND_POSITION_BIT) and not has_bit(mask, _BLEND_HEIGHT_BIT)
    is_blended = parameters.get("GPS_AUTO_SWITCH") == _SWITCH_BLEND and _has_other_receiver(parameters, choice)
    if is_blended and not is_safe:
        yield f"GPS_AUTO_SWITCH={_SWITCH_BEST}"


def _check_lanes(parameters: Parameters, choice: ChannelChoice) -> Iterator[str]:
    """Yield the change that detaches EKF lane n from receiver n (AP_NavEKF3_Measurements.cpp, update_gps_selection)."""
    affinity = parameters.get("EK3_AFFINITY", 0)
    if has_bit(affinity, _AFFINITY_GPS_BIT) and _has_other_receiver(parameters, choice):
        yield f"EK3_AFFINITY={int(affinity) & ~_AFFINITY_GPS_BIT}"


def _check_own_receiver(*checks: Check) -> Check:
    """Combine the checks of the two receivers into one that applies the check of our own receiver."""
    names = tuple(name for check in checks for name in check.names)
    return Check(names, lambda parameters, choice: checks[choice.receiver].find_changes(parameters, choice))


def _name_sources(quantity: str) -> tuple[str, ...]:
    return tuple(f"EK3_SRC{number}_{quantity}" for number in (1, 2, 3))


def _refuse_source(quantity: str, wrong: int, correct: int) -> Check:
    """Return a check that no source set uses the source `wrong` for `quantity`."""
    return expect(correct, *_name_sources(quantity), allows=lambda source: source != wrong)


def _has_source(parameters: Parameters, source: int) -> bool:
    first_set, *other_sets = _name_sources("POSXY")
    return parameters.get(first_set, _SOURCE_GPS) == source or source in map(parameters.get, other_sets)


def _check_source_set(parameters: Parameters, choice: ChannelChoice) -> Iterator[str]:
    """Yield the changes that add our source to a source set: otherwise it is never used (AP_NavEKF_Source.cpp)."""
    if choice.channel is Channel.GPS_INPUT and not _has_source(parameters, _SOURCE_GPS):
        yield f"EK3_SRC1_POSXY={_SOURCE_GPS}"
    if choice.channel is Channel.ODOMETRY and not _has_source(parameters, _SOURCE_VISION):
        yield from _VISION_SET_CHANGES


def _check_set_per_lane(parameters: Parameters, _choice: ChannelChoice) -> Iterator[str]:
    """Yield the change that detaches EKF lane n from source set n (AP_NavEKF_Source.h, getActiveSourceSet)."""
    options = parameters.get("EK3_SRC_OPTIONS", 0)
    is_mixed = _has_source(parameters, _SOURCE_GPS) and _has_source(parameters, _SOURCE_VISION)
    if has_bit(options, _SET_PER_LANE_BIT) and is_mixed:
        yield f"EK3_SRC_OPTIONS={int(options) & ~_SET_PER_LANE_BIT}"


def _check_arming(parameters: Parameters, choice: ChannelChoice) -> Iterator[str]:
    """Yield the changes that enable the arming checks of our channel (AP_Arming.cpp, check_enabled)."""
    bit = _GPS_CHECK_BIT if choice.channel is Channel.GPS_INPUT else _VISION_CHECK_BIT
    if not has_bit(parameters.get("ARMING_CHECK", _ALL_CHECKS_BIT), _ALL_CHECKS_BIT | bit):
        yield f"ARMING_CHECK={_ALL_CHECKS_BIT}"
    if has_bit(parameters.get("ARMING_SKIPCHK", 0), bit):
        yield "ARMING_SKIPCHK=0"


# fmt: off
_RULES = (
    require(_GPS_INPUT, "the index of the real receiver: 0 if GPS2_TYPE is 14, 1 if GPS1_TYPE is",
        Check(("GPS_PRIMARY", "GPS_AUTO_SWITCH", *RECEIVERS), _check_primary),
        "With GPS_AUTO_SWITCH 0 or 4 ArduPilot uses the primary receiver, which is ours, even while GPS is good."),
    recommend(_GPS_INPUT, "1 or 4",
        Check(("GPS_AUTO_SWITCH", "GPS_PRIMARY", "GPS_BLEND_MASK", *RECEIVERS), _check_switch),
        "With 0 our receiver is never used; with 2 it contributes to each position while GPS is good."),
    require(_GPS_INPUT, "1 or 5 if GPS_AUTO_SWITCH is 2",
        Check(("GPS_BLEND_MASK", "GPS_AUTO_SWITCH", *RECEIVERS), _check_blend),
        "Without bit 1, or with bit 2, our receiver has a large weight in each position while GPS is good."),
    require(_GPS_INPUT, "0, or any value without bit 1 (GPS); EK3_PRIMARY may then have any value",
        Check(("EK3_AFFINITY", "EK3_PRIMARY", *RECEIVERS), _check_lanes),
        "With bit 1 a lane of the filter uses our positions even while GPS is good."),
    # AP_GPS.cpp, get_lag: any delay is accepted, but the filter's buffer is limited (NavEKF3_core::setup_core).
    require(_GPS_INPUT,
        f"0 to {_MAX_GPS_DELAY_MS}: edgevpr reads it, and sends the position at that age (0: 0.2 s)",
        _check_own_receiver(*(expect(0, name, allows=make_limit(_MAX_GPS_DELAY_MS)) for name in DELAYS)),
        "With a larger delay, which exceeds its buffer, the filter treats our position as newer.", "GPSn_DELAY_MS"),
    # AP_NavEKF3_Measurements.cpp, CorrectGPSForAntennaOffset: the offset is subtracted from our position.
    require(_GPS_INPUT, f"within {MAX_OFFSET_M:g} m of 0 for our receiver",
        _check_own_receiver(*(expect(0, *list_axes(f"GPS{n}_POS"), allows=is_small_offset) for n in (1, 2))),
        "We send the position of the vehicle itself, which an antenna offset would shift.", "GPSn_POS_*"),
    require(_GPS_INPUT, "1",  # AP_AHRS_DCM.cpp and AP_AHRS.cpp, get_relative_position_D_home
        expect(1, "AHRS_GPS_USE", allows=lambda value: value in (0, 1)),
        "With 2 the height may come from our receiver, which only repeats the autopilot's own height."),
    recommend(_ALL_CHANNELS, "AHRS_EKF_TYPE 3, EK3_ENABLE 1",  # AP_AHRS.cpp, handle_external_position_estimate
        join_checks(expect(1, "EK3_ENABLE"), expect(3, "AHRS_EKF_TYPE")),
        "Only EKF3 accepts our positions: enable EKF3, and reboot the autopilot.", "AHRS_EKF_TYPE"),
    recommend(_CONTINUOUS, "3 in one set for GPS_INPUT; 6 in one set for ODOMETRY",
        Check(_name_sources("POSXY"), _check_source_set),
        "No source set of the filter uses our position.", "EK3_SRCn_POSXY"),
    require(_GPS_INPUT, "not 3",  # AP_NavEKF3_PosVelFusion.cpp, selectHeightForFusion
        _refuse_source("POSZ", _SOURCE_GPS, correct=_SOURCE_BARO),
        "The height would come from our receiver, which repeats the autopilot's own height.", "EK3_SRCn_POSZ"),
    require(_GPS_INPUT, "not 8",  # EKFGSF_yaw.cpp: accelerations have to fit the receiver's velocity
        _refuse_source("YAW", _SOURCE_GSF, correct=_SOURCE_COMPASS),
        "The heading would come from our velocity, which is computed with the autopilot's own heading.",
        "EK3_SRCn_YAW"),
    recommend(_CONTINUOUS, f"above 0, up to {_MAX_GLITCH_RADIUS_M}",  # SelectVelPosFusion
        expect(25, "EK3_GLITCH_RAD", allows=lambda radius_m: 0 < radius_m <= _MAX_GLITCH_RADIUS_M),
        "With 0 the filter accepts every position, even a wrong one; with a larger value it recovers late."),
    recommend(_CONTINUOUS,
        "1, or with bits 8 (GPS) and 262144 (vision); newer firmware: ARMING_SKIPCHK without these bits",
        Check(("ARMING_CHECK",), _check_arming), "ArduPilot arms even if our positions are missing or contradict GPS."),
    # AP_VisualOdom_MAV.cpp: VISO_VEL_M_NSE is used as the accuracy, whatever we send.
    require(_ODOMETRY, "not 6", _refuse_source("VELXY", _SOURCE_VISION, correct=0),
        "Our velocity comes from the same matches as our position; the filter would trust it more than its gyros.",
        "EK3_SRCn_VELXY"),
    require(_ODOMETRY, "POSZ, VELZ and YAW not 6",
        join_checks(
            _refuse_source("POSZ", _SOURCE_VISION, correct=_SOURCE_BARO),
            _refuse_source("VELZ", _SOURCE_VISION, correct=0),
            _refuse_source("YAW", _SOURCE_VISION, correct=_SOURCE_COMPASS)),
        "Height, climb and heading in our ODOMETRY are the autopilot's own: it would confirm them.", "EK3_SRCn_*"),
    require(_ODOMETRY, "without bit 8, if one source set uses GPS and one uses our positions",
        Check(("EK3_SRC_OPTIONS", *_name_sources("POSXY")), _check_set_per_lane),
        "Each lane of the filter has its own source set, so one lane uses our positions while GPS is good."),
    require(_ODOMETRY, "1", expect(1, "VISO_SCALE"),  # AP_VisualOdom_MAV, handle_pose_estimate
        "Any other value scales the distance of our position from the origin."),
    # AP_VisualOdom_Backend.cpp rotates VISION_POSITION_DELTA only; AP_VisualOdom_IntelT265.cpp rotates all messages.
    recommend(_ODOMETRY, "0", expect(0, "VISO_ORIENT"),
        "Our positions must not be rotated; 4.7 does not rotate positions of ODOMETRY, but that may change."),
    require(_ODOMETRY, f"within {MAX_OFFSET_M:g} m of 0",  # CorrectExtNavForSensorOffset
        expect(0, *list_axes("VISO_POS"), allows=is_small_offset),
        "We send the position of the vehicle itself, which a camera offset would shift.", "VISO_POS_*"),
    require(_ODOMETRY, f"10, the default; up to {MAX_DELAY_MS:g}",
        expect(10, "VISO_DELAY_MS", allows=make_limit(MAX_DELAY_MS)),  # AP_NavEKF3_Measurements.cpp, writeExtNavData
        "We send the current position, which would be treated as an old one."),
    require(_ODOMETRY, "0 to 100",  # AP_VisualOdom_MAV.cpp, handle_pose_estimate
        expect(0, "VISO_QUAL_MIN", allows=lambda quality: quality >= 0),
        "With -1 even positions that we mark as bad are used."),
    recommend(_ODOMETRY, f"up to {_MAX_VISION_SD_M}",  # handle_pose_estimate: the minimum standard deviation
        expect(0.2, "VISO_POS_M_NSE", allows=make_limit(_MAX_VISION_SD_M)),
        "With a larger value, an accurate position has no more weight than an inaccurate one."),
)
# fmt: on
ARDUPILOT_TABLE = ParameterTable("ArduPilot", (*RECEIVERS, VISION), _RULES, choose_ardupilot_channel)
