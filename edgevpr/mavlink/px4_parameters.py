"""PX4's channel and the table of its parameters (see `parameters`). Each rule names the file of PX4 1.18.0-beta1 that
it is based on, or is marked `flown`: tested in PX4's own simulator."""

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.channel import Channel, ChannelChoice, Parameters, VehicleKind
from edgevpr.mavlink.messages import SENSOR_ID
from edgevpr.mavlink.parameters import (
    MAX_DELAY_MS,
    MAX_OFFSET_M,
    ParameterTable,
    expect,
    has_bit,
    is_small_offset,
    list_axes,
    make_limit,
    recommend,
    require,
)

POSITION_BIT = 1  # bit of EKF2_AGPn_CTRL
AGP_CONTROL = "EKF2_AGP0_CTRL"  # since 1.18, as is message 296: 1.17.0 has neither
VISION_CONTROL = "EKF2_EV_CTRL"  # other bits may be for another system; before 1.16 the default is 15

_ALL_CHANNELS = (Channel.COMMAND, Channel.SENSOR, Channel.VISION)
_CONTINUOUS = (Channel.SENSOR, Channel.VISION)
_MESSAGE_296 = (Channel.SENSOR,)
_ODOMETRY = (Channel.VISION,)

_GPS_POSITION_BIT = 1  # bits of EKF2_GPS_CTRL
_GPS_VELOCITY_BIT = 4
_HEIGHT_FROM_VISION = 3  # value of EKF2_HGT_REF
_MAX_SD_M = 10  # limit of the minimum error that the filter assumes for a position
_MAX_GATE_SD = 10
_DELAY_CONSEQUENCE = "We send the current position, which would be treated as an old one."


def choose_px4_channel(_kind: VehicleKind, parameters: Parameters) -> ChannelChoice:
    """Choose PX4's channel: message 296 or ODOMETRY if AGP_CONTROL or VISION_CONTROL enables it, else command 43003."""
    fuses_ours = has_bit(parameters.get(AGP_CONTROL, 0), POSITION_BIT)
    if parameters.get(VISION_CONTROL) == POSITION_BIT and not fuses_ours:
        reason = Reason(ReasonCode.BY_ODOMETRY, {"parameter": VISION_CONTROL, "source_set": None})
        return ChannelChoice(Channel.VISION, reason)
    if AGP_CONTROL not in parameters:
        return ChannelChoice(Channel.COMMAND, Reason(ReasonCode.COMMAND_WITHOUT_296, {"parameter": AGP_CONTROL}))
    if fuses_ours:
        return ChannelChoice(Channel.SENSOR, Reason(ReasonCode.BY_MESSAGE_296, {"parameter": AGP_CONTROL}))
    return ChannelChoice(Channel.COMMAND, Reason(ReasonCode.COMMAND_FOR_296, {"parameter": AGP_CONTROL}))


# fmt: off
_RULES = (
    recommend(_ALL_CHANNELS, "7, the default; any value with bit 1",  # gps_control.cpp, controlGnssPosFusion
        expect(7, "EKF2_GPS_CTRL", allows=lambda value: has_bit(value, _GPS_POSITION_BIT)),
        "Only our positions are used, not GPS: this is for an aircraft without GPS."),
    require(_ALL_CHANNELS, "7; with bit 1 also bit 4",  # ekf_helper.cpp, getHorizontalVelocityInnovationTestRatio
        expect(7, "EKF2_GPS_CTRL",
            allows=lambda value: not has_bit(value, _GPS_POSITION_BIT) or has_bit(value, _GPS_VELOCITY_BIT)),
        "Only the velocity shows that PX4 would use GPS again, so we would never stop sending."),
    require(_ALL_CHANNELS, "0", expect(0, "EKF2_GPS_MODE"),  # gps_control.cpp, isGnssPosResetAllowed
        "GPS that recovers far from our position is rejected while airspeed or optical flow is used."),
    recommend(_CONTINUOUS, "0 or 1", expect(1, "EKF2_HGT_REF", allows=lambda value: value != _HEIGHT_FROM_VISION),
        "We send no height: with 3 (vision) PX4 never becomes ready to arm."),  # flown
    recommend(_ALL_CHANNELS, "1", expect(1, "SYS_HAS_GPS"),
        "With 0 PX4 arms without GPS, so the start position may be unknown: this is for an aircraft without GPS."),
    # aux_global_position.cpp: a slot whose ID is 0 at startup does not exist.
    recommend(_MESSAGE_296, f"{SENSOR_ID}", expect(SENSOR_ID, "EKF2_AGP0_ID"),
        "Our positions carry this ID; with any other value they are not used."),
    require(_MESSAGE_296, f"1, the default; up to {_MAX_SD_M}",  # flown
        expect(1, "EKF2_AGP0_NOISE", allows=make_limit(_MAX_SD_M)),
        "PX4 hardly follows our positions and accepts wrong ones: with 50 it was wrong by 20 m, undetected."),
    require(_MESSAGE_296, f"3, the default; up to {_MAX_GATE_SD}",
        expect(3, "EKF2_AGP0_GATE", allows=make_limit(_MAX_GATE_SD)),  # fuseHorizontalPosition
        "The filter accepts every position, even a wrong one."),
    recommend(_MESSAGE_296, "0", expect(0, "EKF2_AGP0_MODE"),  # aux_global_position_control.cpp, isResetAllowed
        "With airspeed or optical flow PX4 never returns to our positions once they are outside the gate."),
    require(_MESSAGE_296, f"0; up to {MAX_DELAY_MS:g}",  # aux_global_position_control.cpp, bufferData
        expect(0, "EKF2_AGP0_DELAY", allows=make_limit(MAX_DELAY_MS)), _DELAY_CONSEQUENCE),
    require(_ODOMETRY, "0", expect(0, "EKF2_EV_NOISE_MD"),  # params_external_vision.yaml
        "With 1 each position is assumed to be accurate to EKF2_EVP_NOISE (0.1 m), whatever we claim."),
    require(_ODOMETRY, f"0.1, the default; up to {_MAX_SD_M}",  # flown
        expect(0.1, "EKF2_EVP_NOISE", allows=make_limit(_MAX_SD_M)),
        "PX4 hardly follows our positions and accepts wrong ones: with 20 it was wrong by 35 m, and landed."),
    require(_ODOMETRY, f"5, the default; up to {_MAX_GATE_SD}",
        expect(5, "EKF2_EVP_GATE", allows=make_limit(_MAX_GATE_SD)),  # ev_pos_control.cpp, controlEvPosFusion
        "The filter accepts every position, even a wrong one."),
    require(_ODOMETRY, f"within {MAX_OFFSET_M:g} m of 0",  # ev_pos_control.cpp, pos_offset_body
        expect(0, *list_axes("EKF2_EV_POS"), allows=is_small_offset),
        "We send the position of the vehicle itself, which a camera offset would shift.", "EKF2_EV_POS_*"),
    require(_ODOMETRY, f"0; up to {MAX_DELAY_MS:g}",
        expect(0, "EKF2_EV_DELAY", allows=make_limit(MAX_DELAY_MS)), _DELAY_CONSEQUENCE),
)
# fmt: on
PX4_TABLE = ParameterTable("PX4", (AGP_CONTROL, VISION_CONTROL), _RULES, choose_px4_channel)
