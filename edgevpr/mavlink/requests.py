"""Requests that arrive over a link: all that the ground, or anybody else, may ask of this companion.

What is not on the list here is not obeyed. There are no parameters to be written.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import IntEnum

from edgevpr import __version__
from edgevpr.mavlink.wire import Message, mavlink

STATUS = mavlink.MAVLINK_MSG_ID_ONBOARD_COMPUTER_STATUS
# The messages whose interval may be set, and the shortest one in seconds. A longer one leaves messages out; none is
# made more often than it is.
SHORTEST_S = {STATUS: 1.0, mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT: 0.1}
LONGEST_S = 3600.0
ANSWERED_MAX = 50  # requests a second; a flood of them must not push out what we have to say ourselves
PAUSED = "not sent: paused by the ground"
_EARLY_SHARE = 0.1  # of an interval: messages that are made once in an interval are not made to the millisecond


class Wish(IntEnum):
    """A wish for the flight: the first parameter of MAV_CMD_USER_1 (31010)."""

    PAUSE = 1
    RESUME = 2
    LEARN = 3
    LEARN_NOTHING = 4


@dataclass(frozen=True, slots=True)
class Wished:
    """A wish, and who has it."""

    wish: Wish
    system_id: int
    component_id: int

    @property
    def sender(self) -> str:
        """The sender as system/component."""
        return f"{self.system_id}/{self.component_id}"


class Wishes:
    """The wishes that wait to be fulfilled, on their way from the links to the loop of the flight. `offered` are those
    that can be fulfilled; there are none before a flight says so. They are used in turns only."""

    def __init__(self) -> None:
        self.offered: Collection[Wish] = ()
        self._waiting: dict[bool, Wished] = {}  # the newest about learning, and the newest about the flight itself
        self._is_paused = False

    def put(self, wished: Wished) -> None:
        """Let a wish wait. Of two that contradict each other only the newer is left."""
        is_about_learning = wished.wish in (Wish.LEARN, Wish.LEARN_NOTHING)
        if not is_about_learning:
            self._is_paused = wished.wish is Wish.PAUSE
        self._waiting[is_about_learning] = wished

    def take(self) -> tuple[Wished, ...]:
        """Return the wishes since the last call."""
        waiting, self._waiting = tuple(self._waiting.values()), {}
        return waiting

    def why_no_fix(self) -> str | None:
        """Return the reason why no fix may be sent, from the acknowledgement of a pause on; None: there is none."""
        return PAUSED if self._is_paused else None


class Requests:
    """The requests that come over one link; `wishes` are handed on. `results` counts commands by the name of their
    result, `ignored` the messages that were for us and had no effect: not on the list, or too many."""

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
        """Take in a message; return the replies. `us` is our system and component id, `heartbeat` makes ours. A
        TIMESYNC is answered with the time of the clock that stamps our messages."""
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
        """Tell whether one of our own messages may be sent at this moment, by the interval that was asked for."""
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
        """Obey a command; return the result (MAV_RESULT), and the message that was asked for, where one was."""
        wanted = command.param1  # a whole float is the key that its integer is, and NaN is none
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
        """Set an interval in microseconds: 0 is the default, -1 switches off."""
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
    """Tell whether a message asks something of us: a PING to nobody, a TIMESYNC without `tc1`, and what is addressed to
    exactly us. A command to all would be acknowledged by everybody."""
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


_ACCEPTED: int = mavlink.MAV_RESULT_ACCEPTED
_DENIED: int = mavlink.MAV_RESULT_DENIED
_NOT_NOW: int = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
