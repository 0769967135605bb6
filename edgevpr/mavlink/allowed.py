"""The list of all that the ground, or anybody else on the link, may ask of this companion.

Pure functions, a message in, the reaction out. What is not on the list is not obeyed. There are no parameters to be
written.
"""

import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from edgevpr import __version__
from edgevpr.mavlink.wire import Message, mavlink
from edgevpr.mavlink.wishes import Wish

STATUS = mavlink.MAVLINK_MSG_ID_ONBOARD_COMPUTER_STATUS
# The messages whose interval may be set, and the shortest one in seconds. A longer one leaves messages out; none is
# made more often than it is.
SHORTEST_S = {STATUS: 1.0, mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT: 0.1}
LONGEST_S = 3600.0

_ACCEPTED, _DENIED, _UNSUPPORTED = (
    mavlink.MAV_RESULT_ACCEPTED,
    mavlink.MAV_RESULT_DENIED,
    mavlink.MAV_RESULT_UNSUPPORTED,
)
_NOT_NOW = mavlink.MAV_RESULT_TEMPORARILY_REJECTED


@dataclass(frozen=True, slots=True)
class Reaction:
    """The reaction to a message: `replies` to be sent, the `result` of a command (MAV_RESULT; None: it was none), a
    `wish` that is to be fulfilled, and the `interval` (message number, seconds; None: the default) that is to be kept.
    One without any of them is that to a message that is for us, and is ignored."""

    replies: tuple[Message, ...] = ()
    result: int | None = None
    wish: Wish | None = None
    interval: tuple[int, float | None] | None = None


IGNORED = Reaction()


def reaction(
    message: Message,
    us: tuple[int, int],
    now_s: float,
    offered: Collection[Wish],
    known: Mapping[int, Callable[[], Message | None]],
) -> Reaction | None:
    """Return the reaction to a message, None where it asks nothing of us.

    `us` is our own system and component id, `offered` are the wishes that can be fulfilled, and `known` makes the
    messages that can be asked for (None: there is none yet). Only what is addressed to exactly us is obeyed: a
    command to all would be acknowledged by everybody.
    """
    sender = message.get_srcSystem(), message.get_srcComponent()
    if sender[0] == 0 or sender == us:
        return None
    match message.get_type():
        case "PING":
            return _pong(message, sender)
        case "TIMESYNC":
            return _time(message, now_s)
        case "COMMAND_ACK":
            return None
    if (getattr(message, "target_system", None), getattr(message, "target_component", None)) != us:
        return None
    if message.get_type() not in ("COMMAND_LONG", "COMMAND_INT"):
        return IGNORED
    match message.command:
        case mavlink.MAV_CMD_USER_1:
            return _wish(message, offered)
        case mavlink.MAV_CMD_REQUEST_MESSAGE:
            return _request(message, known)
        case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return _interval(message)
    return _acknowledged(message, _UNSUPPORTED)


def version() -> Message:
    """Make the AUTOPILOT_VERSION (148) of this companion: the version of edgevpr, and that it speaks MAVLink 2 and
    takes COMMAND_INT."""
    major, minor, patch = (int(each) for each in re.findall(r"\d+", f"{__version__}.0.0")[:3])
    nothing = [0] * 8
    return mavlink.MAVLink_autopilot_version_message(
        capabilities=mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT,
        flight_sw_version=major << 24 | minor << 16 | patch << 8,
        middleware_sw_version=0,
        os_sw_version=0,
        board_version=0,
        flight_custom_version=nothing,
        middleware_custom_version=nothing,
        os_custom_version=nothing,
        vendor_id=0,
        product_id=0,
        uid=0,
    )


def _pong(message: Message, sender: tuple[int, int]) -> Reaction | None:
    """Answer a PING that is a request: it is to nobody. The answer, to its sender, repeats number and time."""
    if (message.target_system, message.target_component) != (0, 0):
        return None
    return Reaction((mavlink.MAVLink_ping_message(message.time_usec, message.seq, *sender),))


def _time(message: Message, now_s: float) -> Reaction | None:
    """Answer a TIMESYNC that is a request, one without `tc1`, with the time of the clock that stamps our messages."""
    if message.tc1 != 0:
        return None
    return Reaction((mavlink.MAVLink_timesync_message(tc1=round(now_s * 1e9), ts1=message.ts1),))


def _wish(command: Message, offered: Collection[Wish]) -> Reaction:
    if command.param1 not in tuple(Wish):  # NaN is in none
        return _acknowledged(command, _DENIED)
    wish = Wish(int(command.param1))
    return _acknowledged(command, _ACCEPTED, wish=wish) if wish in offered else _acknowledged(command, _NOT_NOW)


def _request(command: Message, known: Mapping[int, Callable[[], Message | None]]) -> Reaction:
    if command.param1 not in known:
        return _acknowledged(command, _UNSUPPORTED)
    message = known[command.param1]()  # a whole float is the key that its integer is
    return _acknowledged(command, _ACCEPTED, message) if message else _acknowledged(command, _NOT_NOW)


def _interval(command: Message) -> Reaction:
    """Set an interval in microseconds: 0 is the default, -1 switches off."""
    if command.param1 not in SHORTEST_S:
        return _acknowledged(command, _UNSUPPORTED)
    number, interval_s = int(command.param1), command.param2 / 1e6
    if command.param2 == 0:
        return _acknowledged(command, _ACCEPTED, interval=(number, None))
    if command.param2 == -1:
        return _acknowledged(command, _ACCEPTED, interval=(number, math.inf))
    if not SHORTEST_S[number] <= interval_s <= LONGEST_S:
        return _acknowledged(command, _DENIED)
    return _acknowledged(command, _ACCEPTED, interval=(number, interval_s))


def _acknowledged(
    command: Message,
    result: int,
    *replies: Message,
    wish: Wish | None = None,
    interval: tuple[int, float | None] | None = None,
) -> Reaction:
    ack = mavlink.MAVLink_command_ack_message(
        command=command.command,
        result=result,
        target_system=command.get_srcSystem(),
        target_component=command.get_srcComponent(),
    )
    return Reaction((ack, *replies), result, wish, interval)
