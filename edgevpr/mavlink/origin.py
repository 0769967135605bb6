"""Altitude of the origin that is set for an autopilot without one: that of the ground or, if the map does not know it,
the autopilot's pressure altitude. Positions, velocities and heights of ours do not depend on it; an altitude above sea
level in a mission is wrong by as much."""

import logging
from collections.abc import Callable

from edgevpr.core.types import Position
from edgevpr.mavlink import messages
from edgevpr.mavlink.messages import Severity
from edgevpr.mavlink.wire import Message, mavlink

_log = logging.getLogger(__name__)


class OriginAltitude:
    """Makes the messages that set an origin. `announce(severity, text, topic)` reports, once, that the altitude is
    unknown."""

    def __init__(self, announce: Callable[[Severity, str, str], None]) -> None:
        self._announce = announce
        self._has_asked, self._reported = False, ""

    def place(self, here: Position, system_id: int, pressure_alt_m: float | None) -> Message:
        """Return the message that sets the origin `here`, with its altitude if that is known. If it is not, and neither
        is `pressure_alt_m`, return a request for the air pressure: an origin at a wrong altitude of 0 is never set."""
        alt_m = pressure_alt_m if here.alt_m is None else here.alt_m
        if alt_m is None:
            if self._has_asked:
                self._report("set EKF origin", "the autopilot does not report the air pressure either")
            self._has_asked = True
            return messages.message_request(system_id, mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE)
        self._has_asked = False  # an autopilot that restarts is asked again
        if here.alt_m is None:
            self._report(f"about {alt_m:.0f} m", "the autopilot's pressure altitude is sent, it may be 150 m off")
        return messages.origin(system_id, here.lat_deg, here.lon_deg, alt_m)

    def _report(self, text: str, why: str) -> None:
        if text == self._reported:
            return
        self._reported = text
        advice = "before a mission with altitudes above sea level, set the EKF origin from the ground station"
        _log.warning("origin altitude unknown: %s (%s); %s", text, why, advice)
        self._announce(Severity.WARNING, f"origin altitude unknown: {text}", "origin")
