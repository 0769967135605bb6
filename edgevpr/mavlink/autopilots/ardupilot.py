"""ArduPilot: which channel it takes positions by. Read off 4.7-dev and tried on it in simulation."""

from collections.abc import Mapping

from edgevpr.mavlink.autopilots.channel import Asked, Channel, Choice, Kind

MAVLINK_GPS = 14  # of GPSn_TYPE: positions come as GPS_INPUT
_MAVLINK_VISION = 1  # of VISO_TYPE
# AP_GPS takes the positions of a receiver that does not say how late they are to be so old (GPS_Backend::get_lag).
_GPS_LAG_S = 0.2

# The names of the receivers' parameters since 4.6, and before.
_RECEIVERS = (("GPS1_TYPE", "GPS_TYPE"), ("GPS2_TYPE", "GPS_TYPE2"))
_DELAYS = (("GPS1_DELAY_MS", "GPS_DELAY_MS"), ("GPS2_DELAY_MS", "GPS_DELAY_MS2"))
_VISION = "VISO_TYPE"
PARAMETERS = (*(name for names in _RECEIVERS + _DELAYS for name in names), _VISION)
SECOND = 1  # the number of the receiver that we are to be


def choice(asked: Asked) -> Choice:
    """Choose the channel for an ArduPilot: what its operator has set up for us, else single fixes.

    A plane reckons without GPS for as long as it flies, and takes a fix at any time (`NavEKF3_core::setLatLng`). A
    copter without GPS and optical flow lands some seconds later, a rover stops, and no single fix prevents that.
    """
    parameters = asked.parameters
    for number in range(len(_RECEIVERS)):
        name = receiver_name(parameters, number)
        if parameters.get(name) == MAVLINK_GPS:
            delay_ms = parameters.get(_known(parameters, _DELAYS[number]))
            reason = f"GPS_INPUT as receiver {number + 1}, as its {name} is {MAVLINK_GPS}"
            return Choice(Channel.GPS_INPUT, reason, number, delay_ms / 1e3 if delay_ms else _GPS_LAG_S)
    if parameters.get(_VISION) == _MAVLINK_VISION:
        return Choice(Channel.ODOMETRY, f"ODOMETRY, as its {_VISION} is {_MAVLINK_VISION}")
    if asked.kind is Kind.PLANE:
        return Choice(Channel.COMMAND, "command 43003, which a plane that reckons takes at any time")
    return Choice(
        Channel.COMMAND,
        f"command 43003, which a {asked.kind.value} without GPS takes only as long as optical flow carries it: set "
        f"{receiver_name(parameters, SECOND)}={MAVLINK_GPS} to give it a continuous position",
    )


def receiver_name(parameters: Mapping[str, float], number: int) -> str:
    """Return the name that this firmware has for the type of a receiver (0: the first)."""
    return _known(parameters, _RECEIVERS[number])


def _known(parameters: Mapping[str, float], names: tuple[str, ...]) -> str:
    return next((name for name in names if name in parameters), names[0])
