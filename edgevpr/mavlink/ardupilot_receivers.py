"""The rows of ArduPilot's table (see `parameters`) for GPS receivers, of which edgevpr is one by GPS_INPUT: a real one
with a fix must always come first. Each row names the file of ArduPilot 4.7-dev that decides."""

from collections.abc import Iterator

from edgevpr.mavlink.channel import DELAYS, RECEIVERS, Channel, Choice, read_value
from edgevpr.mavlink.parameters import MAX_OFFSET_M, ParameterRule, Parameters, demand, has_bit, name_axes

_BY_GPS = (Channel.GPS_INPUT,)

# Values of GPS_AUTO_SWITCH.
_PRIMARY_ALWAYS, _BEST, _BLEND, _PRIMARY_WHILE_FIXED = 0, 1, 2, 4
_BLENDS_POSITION, _BLENDS_HEIGHT = 1, 2  # bits of GPS_BLEND_MASK
_GPS_LANES = 1  # bit of EK3_AFFINITY
_MAX_DELAY_MS = 250  # EK3's buffer is never longer: AP_NavEKF3_core.cpp, setup_core


def _has_other_receiver(parameters: Parameters, choice: Choice) -> bool:
    return read_value(parameters, RECEIVERS[1 - choice.receiver], 0) != 0


def _find_primary(parameters: Parameters) -> int:
    """Return the index of the receiver that ArduPilot takes for the primary one (AP_GPS::update_primary)."""
    is_second = parameters.get("GPS_PRIMARY") == 1 and read_value(parameters, RECEIVERS[1], 0) != 0
    return int(is_second)


def _yield_primary(parameters: Parameters, choice: Choice) -> Iterator[str]:
    """AP_GPS.cpp, update_primary: the primary receiver, while it has a 3D fix, or for ever."""
    switch = parameters.get("GPS_AUTO_SWITCH", _BEST)
    is_ours = _find_primary(parameters) == choice.receiver
    if switch in (_PRIMARY_ALWAYS, _PRIMARY_WHILE_FIXED) and is_ours and _has_other_receiver(parameters, choice):
        yield f"GPS_PRIMARY={1 - choice.receiver}"
        if switch == _PRIMARY_ALWAYS:
            yield f"GPS_AUTO_SWITCH={_BEST}"


def _yield_switch(parameters: Parameters, choice: Choice) -> Iterator[str]:
    """AP_GPS.cpp, update_primary: with 0 no other receiver is ever used; 2 uses all of them."""
    switch = parameters.get("GPS_AUTO_SWITCH", _BEST)
    is_ours = _find_primary(parameters) == choice.receiver
    if switch in (_BEST, _PRIMARY_WHILE_FIXED) or (is_ours and switch == _PRIMARY_ALWAYS):
        return
    if switch != _BLEND or (_has_other_receiver(parameters, choice) and not any(_yield_blend(parameters, choice))):
        yield f"GPS_AUTO_SWITCH={_BEST}"


def _yield_blend(parameters: Parameters, choice: Choice) -> Iterator[str]:
    """AP_GPS_Blended.cpp, _calc_weights: the mean of one weight for each bit of the mask. By horizontal accuracy ours
    is about 0.01, by speed 0.1. By height it is a third to a half, since our height is the autopilot's own."""
    mask = parameters.get("GPS_BLEND_MASK", 5)
    is_safe = has_bit(mask, _BLENDS_POSITION) and not has_bit(mask, _BLENDS_HEIGHT)
    is_blended = parameters.get("GPS_AUTO_SWITCH") == _BLEND and _has_other_receiver(parameters, choice)
    if is_blended and not is_safe:
        yield f"GPS_AUTO_SWITCH={_BEST}"


def _yield_lanes(parameters: Parameters, choice: Choice) -> Iterator[str]:
    """AP_NavEKF3_Measurements.cpp, update_gps_selection: lane n flies by receiver n while that has a 3D fix."""
    affinity = parameters.get("EK3_AFFINITY", 0)
    if has_bit(affinity, _GPS_LANES) and _has_other_receiver(parameters, choice):
        yield f"EK3_AFFINITY={int(affinity) & ~_GPS_LANES}"


def _yield_delay(parameters: Parameters, choice: Choice) -> Iterator[str]:
    """AP_GPS.cpp, get_lag: any delay is believed, but the filter's buffer ends (NavEKF3_core::setup_core)."""
    yield from demand(0, DELAYS[choice.receiver], allows=lambda ms: ms <= _MAX_DELAY_MS)(parameters, choice)


def _yield_antenna(parameters: Parameters, choice: Choice) -> Iterator[str]:
    """AP_NavEKF3_Measurements.cpp, CorrectGPSForAntennaOffset: it is taken off our position."""
    names = name_axes(f"GPS{choice.receiver + 1}_POS")
    yield from demand(0, *names, allows=lambda offset_m: abs(offset_m) <= MAX_OFFSET_M)(parameters, choice)


RECEIVER_RULES = (
    ParameterRule(
        label="GPS_PRIMARY",
        names=("GPS_PRIMARY", "GPS_AUTO_SWITCH", *RECEIVERS),
        channels=_BY_GPS,
        right="the index of the real receiver: 0 if GPS2_TYPE is 14, 1 if GPS1_TYPE is",
        is_dangerous=True,
        why="With GPS_AUTO_SWITCH 0 or 4 it flies by us, the primary receiver, while GPS is good.",
        find_changes=_yield_primary,
    ),
    ParameterRule(
        label="GPS_AUTO_SWITCH",
        names=("GPS_AUTO_SWITCH", "GPS_PRIMARY", "GPS_BLEND_MASK", *RECEIVERS),
        channels=_BY_GPS,
        right="1; 4 is as good",
        is_dangerous=False,
        why="With 0 our receiver is never used; with 2 a part of each position is ours while GPS is good.",
        find_changes=_yield_switch,
    ),
    ParameterRule(
        label="GPS_BLEND_MASK",
        names=("GPS_BLEND_MASK", "GPS_AUTO_SWITCH", *RECEIVERS),
        channels=_BY_GPS,
        right="1 or 5, where GPS_AUTO_SWITCH is 2",
        is_dangerous=True,
        why="Without the bit 1, or with the bit 2, a large part of each position is ours while GPS is good.",
        find_changes=_yield_blend,
    ),
    ParameterRule(
        label="EK3_AFFINITY",
        names=("EK3_AFFINITY", "EK3_PRIMARY", *RECEIVERS),
        channels=_BY_GPS,
        right="0, or any value without the bit 1 (GPS); then EK3_PRIMARY may be any",
        is_dangerous=True,
        why="With the bit 1 a lane of the filter flies by us while GPS is good.",
        find_changes=_yield_lanes,
    ),
    ParameterRule(
        label="GPSn_DELAY_MS",
        names=DELAYS,
        channels=_BY_GPS,
        right=f"0 to {_MAX_DELAY_MS}: edgevpr reads it, and sends where it was so long ago (0: 0.2 s)",
        is_dangerous=True,
        why="The filter cannot take a position so far back, and would take it for a newer one.",
        find_changes=_yield_delay,
    ),
    ParameterRule(
        label="GPSn_POS_*",
        names=(*name_axes("GPS1_POS"), *name_axes("GPS2_POS")),
        channels=_BY_GPS,
        right=f"within {MAX_OFFSET_M:g} m of 0 for our receiver",
        is_dangerous=True,
        why="We send the position of the vehicle itself, and an antenna's place would move it.",
        find_changes=_yield_antenna,
    ),
    ParameterRule(
        label="AHRS_GPS_USE",
        names=("AHRS_GPS_USE",),
        channels=_BY_GPS,
        right="1",
        is_dangerous=True,
        # AP_AHRS_DCM.cpp and AP_AHRS.cpp, get_relative_position_D_home.
        why="With 2 the height can come from our receiver, and that is the autopilot's own height.",
        find_changes=demand(1, "AHRS_GPS_USE", allows=lambda value: value in (0, 1)),
    ),
)
