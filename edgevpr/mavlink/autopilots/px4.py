"""PX4: which channel it takes positions by. Read off 1.17-alpha."""

from edgevpr.mavlink.autopilots.channel import Asked, Channel, Choice

FUSES_POSITION = 1  # bit of EKF2_AGPn_CTRL
CONTROL = "EKF2_AGP0_CTRL"
SENSOR_ID = 1  # in our messages 296, and of EKF2_AGP0_ID: 0 switches the slot off
PARAMETERS = (CONTROL,)
_SINCE = (1, 17)


def choice(asked: Asked) -> Choice:
    """Choose the channel for a PX4: message 296 where it has been told to fuse it, else command 43003. It fuses both,
    and falls back to single fixes by itself; it drops a 296 that says no accuracy, and its own delay is a parameter."""
    if not _knows_sensor(asked):
        major, minor = asked.version
        return Choice(Channel.COMMAND, f"command 43003, as version {major}.{minor} knows no message 296 (1.17 does)")
    if int(asked.parameters.get(CONTROL, 0)) & FUSES_POSITION:
        return Choice(Channel.SENSOR, f"message 296, as its {CONTROL} fuses positions")
    return Choice(Channel.COMMAND, f"command 43003, as its {CONTROL} fuses no positions of message 296")


def can_fuse(asked: Asked) -> bool:
    """Tell whether this PX4 can be told to fuse message 296."""
    return _knows_sensor(asked) and CONTROL in asked.parameters


def _knows_sensor(asked: Asked) -> bool:
    return asked.version is None or asked.version >= _SINCE
