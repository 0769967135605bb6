"""ArduPilot: which channel it takes positions by. Read off 4.7-dev and tried on it in simulation."""

from edgevpr.mavlink.autopilots.channel import Asked, Channel, Choice, Kind

_MAVLINK_GPS = 14  # of GPSn_TYPE: positions come as GPS_INPUT
_MAVLINK_VISION = 1  # of VISO_TYPE
# AP_GPS takes the positions of a receiver that does not say how late they are to be so old (GPS_Backend::get_lag).
_GPS_LAG_S = 0.2

# The names of the receivers' parameters since 4.6, and before.
_RECEIVERS = (("GPS1_TYPE", "GPS_TYPE"), ("GPS2_TYPE", "GPS_TYPE2"))
_DELAYS = (("GPS1_DELAY_MS", "GPS_DELAY_MS"), ("GPS2_DELAY_MS", "GPS_DELAY_MS2"))
_VISION = "VISO_TYPE"
PARAMETERS = (*(name for names in _RECEIVERS + _DELAYS for name in names), _VISION)


def choice(asked: Asked) -> Choice:
    """Choose the channel for an ArduPilot: what its operator has set up for us, else single fixes.

    A plane reckons without GPS for as long as it flies, and takes a fix at any time (`NavEKF3_core::setLatLng`). A
    copter without GPS and optical flow lands some seconds later, and no single fix prevents that.
    """
    for number, names in enumerate(_RECEIVERS):
        if _first(asked, names) == _MAVLINK_GPS:
            delay_ms = _first(asked, _DELAYS[number])
            reason = f"GPS_INPUT as receiver {number + 1}, as its {names[0]} is {_MAVLINK_GPS}"
            return Choice(Channel.GPS_INPUT, reason, number, delay_ms / 1e3 if delay_ms else _GPS_LAG_S)
    if asked.parameters.get(_VISION) == _MAVLINK_VISION:
        return Choice(Channel.ODOMETRY, f"ODOMETRY, as its {_VISION} is {_MAVLINK_VISION}")
    if asked.kind is Kind.COPTER:
        return Choice(
            Channel.COMMAND,
            "command 43003, which a copter without GPS takes only as long as optical flow carries it: set GPS2_TYPE=14 "
            "to give it a continuous position",
        )
    return Choice(Channel.COMMAND, f"command 43003, which a {asked.kind.value} that reckons takes at any time")


def _first(asked: Asked, names: tuple[str, ...]) -> float | None:
    return next((asked.parameters[name] for name in names if name in asked.parameters), None)
