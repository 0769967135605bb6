"""The requests that arrive over a link: what is kept of them, from one to the next, and how many are answered."""

import math
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from threading import Lock

from edgevpr.mavlink.ground import STATUS, Wish, reaction, version
from edgevpr.mavlink.wire import Message, mavlink

ANSWERED_MAX = 50  # requests a second; a flood of them must not push out what we have to say ourselves
_EARLY = 0.1  # of an interval: messages that are made once in an interval are not made to the millisecond

PAUSED = "not sent: paused by the ground"


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


class Requests:
    """The requests to this companion. `results` counts commands by the name of their result, `ignored` the messages
    that were for us and had no effect: not on the list of `ground`, or too many.

    `offer` and `take_wishes` may be called from any thread, all else from that of the link.
    """

    def __init__(self) -> None:
        self.results: Counter[str] = Counter()
        self.ignored = 0
        self._offered: Collection[Wish] = ()
        self._lock = Lock()
        self._wishes: dict[bool, Wished] = {}  # the newest of learning, and of the flight itself
        self._is_paused = False
        self._intervals_s: dict[int, float] = {}
        self._sent_s: dict[tuple[int, str], float] = {}
        self._status: Message | None = None
        self._second_s, self._answered = 0.0, 0

    def offer(self, wishes: Collection[Wish]) -> None:
        """Set the wishes that can be fulfilled from now on; there are none before the first call."""
        self._offered = wishes

    def take_wishes(self) -> tuple[Wished, ...]:
        """Return the wishes since the last call. Of two that contradict each other only the newer is left."""
        with self._lock:
            wishes, self._wishes = tuple(self._wishes.values()), {}
        return wishes

    def hear(
        self, message: Message, us: tuple[int, int], now_s: float, heartbeat: Callable[[], Message]
    ) -> tuple[Message, ...]:
        """Take in a message; return the replies. `us` is our system and component id, `heartbeat` makes ours."""
        known = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: version,
            STATUS: lambda: self._status,
        }
        found = reaction(message, us, now_s, self._offered, known)
        if found is None:
            return ()
        if not found.replies or not self._may_answer(now_s):
            self.ignored += 1
            return ()
        if found.result is not None:
            self.results[mavlink.enums["MAV_RESULT"][found.result].name.removeprefix("MAV_RESULT_")] += 1
        if found.wish:
            self._note(Wished(found.wish, message.get_srcSystem(), message.get_srcComponent()))
        if found.interval:
            number, interval_s = found.interval
            self._intervals_s[number] = interval_s or 0.0
        return found.replies

    def why_no_fix(self) -> str | None:
        """Return the reason why no fix may be sent, from the acknowledgement of a pause on; None: there is none."""
        return PAUSED if self._is_paused else None

    def admits(self, message: Message, now_s: float) -> bool:
        """Tell whether one of our own messages may be sent at this moment, by the interval that was asked for."""
        number = message.get_msgId()
        if number == STATUS:
            self._status = message
        if not (interval_s := self._intervals_s.get(number)):
            return True
        key = number, getattr(message, "name", "")
        if interval_s == math.inf or now_s - self._sent_s.get(key, -math.inf) < (1 - _EARLY) * interval_s:
            return False
        self._sent_s[key] = now_s
        return True

    def _may_answer(self, now_s: float) -> bool:
        if now_s - self._second_s >= 1.0:
            self._second_s, self._answered = now_s, 0
        self._answered += 1
        return self._answered <= ANSWERED_MAX

    def _note(self, wished: Wished) -> None:
        about_learning = wished.wish in (Wish.LEARN, Wish.LEARN_NOTHING)
        if not about_learning:
            self._is_paused = wished.wish is Wish.PAUSE
        with self._lock:
            self._wishes[about_learning] = wished
