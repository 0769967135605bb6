"""Requests that arrive over a link: all that the ground station, or any other sender, may ask of this companion
computer. A request that is not handled here has no effect; there are no parameters that could be set. A wish is a
request that only the flight itself can fulfil, such as a pause. Used by `conversation` and the flight."""

import math
import re
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import IntEnum

from edgevpr import __version__
from edgevpr.mavlink.wire import Message, mavlink

STATUS = mavlink.MAVLINK_MSG_ID_ONBOARD_COMPUTER_STATUS
# The messages whose interval may be set, and the shortest interval in seconds. A long one leaves messages out; a short
# one does not make them more frequent than they are.
SHORTEST_S = {STATUS: 1.0, mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT: 0.1}
LONGEST_S = 3600.0
ANSWERED_MAX = 50  # requests a second; the answers to a flood of them must not displace our own messages
PAUSED = "not sent: paused by the ground"
_EARLY_SHARE = 0.1  # of an interval: a message may come early by this much, because its timing is not exact


class Wish(IntEnum):
    """A request to the flight; the value is the first parameter of MAV_CMD_USER_1 (31010)."""

    PAUSE = 1
    RESUME = 2
    LEARN = 3
    LEARN_NOTHING = 4


@dataclass(frozen=True, slots=True)
class Wished:
    """A wish, with the system and component id of the sender that made it."""

    wish: Wish
    system_id: int
    component_id: int

    @property
    def sender(self) -> str:
        """The sender as the text "system/component"."""
        return f"{self.system_id}/{self.component_id}"


class Wishes:
    """The wishes that wait until the main loop of the flight takes them; all links put theirs here. `offered` are those
    that the flight can fulfil, none at first; others are refused. Use it inside turns only (see `turns`)."""

    def __init__(self) -> None:
        self.offered: Collection[Wish] = ()
        self._waiting: dict[bool, Wished] = {}  # the newest about learning (True), and about pausing (False)
        self._is_paused = False

    def put(self, wished: Wished) -> None:
        """Add a wish. It replaces a waiting one of the same subject: pause and resume, or learning and not learning."""
        is_about_learning = wished.wish in (Wish.LEARN, Wish.LEARN_NOTHING)
        if not is_about_learning:
            self._is_paused = wished.wish is Wish.PAUSE
        self._waiting[is_about_learning] = wished

    def take(self) -> tuple[Wished, ...]:
        """Return the wishes put since the last call."""
        waiting, self._waiting = tuple(self._waiting.values()), {}
        return waiting

    def why_no_fix(self) -> str | None:
        """Return the reason why no fix may be sent, as soon as a pause has been accepted; None: fixes may be sent."""
        return PAUSED if self._is_paused else None


class Requests:
    """Answers the requests of one link, and puts its wishes into `wishes`. `results` counts commands by the name of
    their result. `ignored` counts the other messages addressed to us that had no effect: an unknown kind, or too many a
    second."""

    def __init__(self, wishes: Wishes) -> None:
        self.results: Counter[str] = Counter()
        self.ignored = 0
        self._wishes = wishes
        self._intervals_s: dict[int, float] = {}
        self._sent_s: dict[tuple[int, str], float] = {}
        self._status: Message | None = None
        self._second_s, self._answered = 0.0, 0

    def hear(
        self, message: Message, us: tuple[int, int], now_s: float, heartbeat: Callable[[], Message]
    ) -> tuple[Message, ...]:
        """Process a message and return the replies to be sent. `us` is our (system id, component id); `heartbeat` makes
        our heartbeat, should it be requested. A TIMESYNC is answered with `now_s`, the clock of all our time stamps."""
        sender = message.get_srcSystem(), message.get_srcComponent()
        if sender[0] == 0 or sender == us or not _asks(message, us):
            return ()
        kind = message.get_type()
        if kind not in ("PING", "TIMESYNC", "COMMAND_LONG", "COMMAND_INT") or not self._may_answer(now_s):
            self.ignored += 1
            return ()
        if kind == "PING":
            return (mavlink.MAVLink_ping_message(message.time_usec, message.seq, *sender),)
        if kind == "TIMESYNC":
            return (mavlink.MAVLink_timesync_message(tc1=round(now_s * 1e9), ts1=message.ts1),)
        result, replies = self._obey(message, heartbeat)
        self.results[mavlink.enums["MAV_RESULT"][result].name.removeprefix("MAV_RESULT_")] += 1
        ack = mavlink.MAVLink_command_ack_message(
            command=message.command, result=result, target_system=sender[0], target_component=sender[1]
        )
        return (ack, *replies)

    def admits(self, message: Message, now_s: float) -> bool:
        """Return True if one of our own messages may be sent now, by the interval requested for its kind."""
        number = message.get_msgId()
        if number == STATUS:
            self._status = message
        if not (interval_s := self._intervals_s.get(number)):
            return True
        key = number, getattr(message, "name", "")
        if interval_s == math.inf or now_s - self._sent_s.get(key, -math.inf) < (1 - _EARLY_SHARE) * interval_s:
            return False
        self._sent_s[key] = now_s
        return True

    def _obey(self, command: Message, heartbeat: Callable[[], Message]) -> tuple[int, tuple[Message, ...]]:
        """Execute a command. Returns:
        - its result, a MAV_RESULT;
        - the messages that it requested.
        """
        wanted = command.param1  # a float: as a key, a whole one equals its integer, and NaN equals none
        match command.command:
            case mavlink.MAV_CMD_USER_1:
                return self._take_wish(command, wanted), ()
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                known: dict[int, Callable[[], Message | None]] = {
                    mavlink.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
                    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: version,
                    STATUS: lambda: self._status,
                }
                if wanted in known:
                    message = known[wanted]()
                    return (_ACCEPTED, (message,)) if message else (_NOT_NOW, ())
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL if wanted in SHORTEST_S:
                return self._set_interval(int(wanted), command.param2), ()
        return mavlink.MAV_RESULT_UNSUPPORTED, ()

    def _take_wish(self, command: Message, wanted: float) -> int:
        if wanted not in tuple(Wish):
            return _DENIED
        wish = Wish(int(wanted))
        if wish not in self._wishes.offered:
            return _NOT_NOW
        self._wishes.put(Wished(wish, command.get_srcSystem(), command.get_srcComponent()))
        return _ACCEPTED

    def _set_interval(self, number: int, interval_us: float) -> int:
        """Set the interval of message `number` and return a MAV_RESULT. `interval_us` is in microseconds; 0: default,
        -1: never."""
        interval_s = math.inf if interval_us == -1 else interval_us / 1e6
        if interval_us not in (0, -1) and not SHORTEST_S[number] <= interval_s <= LONGEST_S:
            return _DENIED
        self._intervals_s[number] = interval_s
        return _ACCEPTED

    def _may_answer(self, now_s: float) -> bool:
        if now_s - self._second_s >= 1.0:
            self._second_s, self._answered = now_s, 0
        self._answered += 1
        return self._answered <= ANSWERED_MAX


def _asks(message: Message, us: tuple[int, int]) -> bool:
    """Return True if a message asks something of us: a PING to nobody in particular, a TIMESYNC without `tc1`, or a
    message addressed to exactly us. A command to all is not for us, since every component would acknowledge it."""
    target = getattr(message, "target_system", None), getattr(message, "target_component", None)
    match message.get_type():
        case "PING":
            return target == (0, 0)
        case "TIMESYNC":
            return bool(message.tc1 == 0)
        case "COMMAND_ACK":
            return False
    return target == us


def version() -> Message:
    """Make the AUTOPILOT_VERSION (148) of this companion: the version of edgevpr, and that it uses MAVLink 2."""
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


_ACCEPTED: int = mavlink.MAV_RESULT_ACCEPTED
_DENIED: int = mavlink.MAV_RESULT_DENIED
_NOT_NOW: int = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
