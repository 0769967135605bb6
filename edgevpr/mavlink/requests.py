"""The requests that arrive over a link: what is kept of them, from one to the next, and how many are answered."""

import math
from collections import Counter
from collections.abc import Callable

from edgevpr.mavlink.allowed import STATUS, reaction, version
from edgevpr.mavlink.wire import Message, mavlink
from edgevpr.mavlink.wishes import Wished, Wishes

ANSWERED_MAX = 50  # requests a second; a flood of them must not push out what we have to say ourselves
_EARLY = 0.1  # of an interval: messages that are made once in an interval are not made to the millisecond


class Requests:
    """The requests that come over one link; `wishes` are handed on. `results` counts commands by the name of their
    result, `ignored` the messages that were for us and had no effect: not on the list of `allowed`, or too many."""

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
        """Take in a message; return the replies. `us` is our system and component id, `heartbeat` makes ours."""
        known = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: version,
            STATUS: lambda: self._status,
        }
        found = reaction(message, us, now_s, self._wishes.offered, known)
        if found is None:
            return ()
        if not found.replies or not self._may_answer(now_s):
            self.ignored += 1
            return ()
        if found.result is not None:
            self.results[mavlink.enums["MAV_RESULT"][found.result].name.removeprefix("MAV_RESULT_")] += 1
        if found.wish:
            self._wishes.put(Wished(found.wish, message.get_srcSystem(), message.get_srcComponent()))
        if found.interval:
            number, interval_s = found.interval
            self._intervals_s[number] = interval_s or 0.0
        return found.replies

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
