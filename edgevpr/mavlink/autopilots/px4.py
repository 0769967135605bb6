"""PX4: which channel it takes positions by. Read off 1.17-alpha."""

from edgevpr.mavlink.autopilots.channel import Asked, Channel, Choice

_FUSES_POSITION = 1  # bit of EKF2_AGPn_CTRL
_SINCE = (1, 17)
_AUXILIARY = "EKF2_AGP0_CTRL"
PARAMETERS = (_AUXILIARY,)


def choice(asked: Asked) -> Choice:
    """Choose the channel for a PX4: message 296 where it has been told to fuse it, else command 43003. It fuses both,
    and falls back to single fixes by itself; it drops a 296 that says no accuracy, and its own delay is a parameter."""
    if asked.version is not None and asked.version < _SINCE:
        major, minor = asked.version
        return Choice(Channel.COMMAND, f"command 43003, as version {major}.{minor} knows no message 296 (1.17 does)")
    if int(asked.parameters.get(_AUXILIARY, 0)) & _FUSES_POSITION:
        return Choice(Channel.SENSOR, f"message 296, as its {_AUXILIARY} fuses positions")
    return Choice(Channel.COMMAND, f"command 43003, as its {_AUXILIARY} fuses no positions of message 296")
