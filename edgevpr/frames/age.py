"""The time at which the pictures of a stream were taken, on this machine's clock."""

import math
from collections import deque
from statistics import median

_RESTART_S = 5.0  # a longer jump of the delay: the sender has begun anew, or something has held the stream up
_BACKLOG_S = 0.005  # a picture that comes sooner than all before it by more has waited to be fetched
_IN_TIME = 3  # pictures in a row after which none is waiting any more
_WAITED_S = 0.002  # a picture that took longer to get was not there before
_USUAL_OF, _AS_USUAL = 9, 1.5  # waits whose median is the usual one, and the share of it that is no delay
_WINDOW_S, _STEADY_S = 5.0, 0.2  # delays that differ by no more for so long are the way, and not a jam


class StampedTime:
    """Time by the stream's own time stamps.

    They share no zero with this machine's clock: the least delay seen so far is taken for none, and all that a picture
    took longer is its age. That least delay is forgotten only for another one that has been steady for five seconds, as
    when clocks drift or the sender has paused: delays in a jam waver, and may last. `is_live`: what waited for the
    opening has been fetched."""

    def __init__(self) -> None:
        self._begin_anew()

    def arrived(self, stamp_s: float, order_s: float, t_mono_s: float) -> None:
        """Take note that a picture with this stamp has arrived. `order_s` is its stamp in the order of decoding, the
        same but for pictures that are sent out of turn."""
        delay_s, order_delay_s = t_mono_s - stamp_s, t_mono_s - order_s
        if order_s < self._order_s or abs(order_delay_s - self._order_delay_s) > _RESTART_S:
            self._begin_anew()
        self._in_time = self._in_time + 1 if order_delay_s > self._least_order_delay_s - _BACKLOG_S else 0
        self.is_live = self.is_live or self._in_time >= _IN_TIME
        self._order_s, self._order_delay_s = order_s, order_delay_s
        self._least_order_delay_s = min(self._least_order_delay_s, order_delay_s)
        self._look_back(t_mono_s, delay_s, order_delay_s)
        self._least_s = min(self._least_s, delay_s)

    def taken_s(self, stamp_s: float, t_mono_s: float) -> float | None:
        """Return the time at which the picture with this stamp was taken, `t_mono_s` at the latest. None while what has
        waited since the opening is still being fetched: how old that is cannot be known."""
        if not self.is_live:
            return None
        return min(t_mono_s, stamp_s + self._least_s)

    def _look_back(self, t_mono_s: float, delay_s: float, order_delay_s: float) -> None:
        if self._window and t_mono_s - self._window[0][0] > _WINDOW_S:
            _, delays_s, order_delays_s = zip(*self._window, strict=True)
            if max(order_delays_s) - min(order_delays_s) < _STEADY_S:
                self._least_s = min(delays_s)
            self._window.clear()
        self._window.append((t_mono_s, delay_s, order_delay_s))

    def _begin_anew(self) -> None:
        self.is_live, self._in_time = False, 0
        self._order_s, self._order_delay_s = -math.inf, math.nan
        self._least_order_delay_s = self._least_s = math.inf
        self._window: list[tuple[float, float, float]] = []


class UnstampedTime:
    """Time for streams without time stamps (MJPEG over HTTP). A picture that was waited for, for no longer than usual,
    has just come. One that took longer may have been held up on its way: it has come since it was asked for. One that
    was there already may have come at any moment since the last one that was waited for."""

    def __init__(self, opened_s: float) -> None:
        self._since_s = opened_s
        self._waits_s: deque[float] = deque(maxlen=_USUAL_OF)

    def taken_s(self, asked_s: float, t_mono_s: float) -> float:
        """Return the time of the picture asked for at `asked_s` and got at `t_mono_s`: where that is in doubt, the
        earliest at which it can have come."""
        wait_s = t_mono_s - asked_s
        if wait_s > _WAITED_S:
            usual_s = median(self._waits_s) if len(self._waits_s) == _USUAL_OF else 0.0
            self._since_s = t_mono_s if wait_s <= _AS_USUAL * usual_s else asked_s
            self._waits_s.append(wait_s)
        return self._since_s
