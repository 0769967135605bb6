"""The value of a parameter, as autopilots send it."""

import math
import struct

from edgevpr.mavlink.wire import Message, mavlink


def value_of(said: Message, bytewise: bool) -> float | int | None:
    """Read a PARAM_VALUE: its float32 is the number itself or, where the autopilot works `bytewise` (PX4), holds the
    bytes of a whole number. None: it is no number."""
    is_whole = said.param_type < mavlink.MAV_PARAM_TYPE_REAL32
    if is_whole and bytewise:
        return struct.unpack("<i", struct.pack("<f", said.param_value))[0]
    if not math.isfinite(said.param_value):
        return None
    return int(said.param_value) if is_whole else said.param_value
