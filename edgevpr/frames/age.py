"""The time at which the pictures of a stream were taken, on this machine's clock."""

import math

_RESTART_S = 5.0  # a longer jump of the delay: the sender has begun anew, or something has held the stream up
_BACKLOG_S = 0.005  # a picture that comes sooner than all before it by more has waited to be fetched
_IN_TIME = 3  # pictures in a row after which none is waiting any more
_WAITED_S = 0.002  # a picture that took longer to get was not there before
_WINDOW_S = 5.0  # two of these are looked back on


class StampedTime:
    """Time by the stream's own time stamps.

    They share no zero with this machine's clock: the least delay seen in the last 5 to 10 s is taken for none, and all
    that a picture took longer is its age. Older delays are forgotten, so that clocks that drift do no harm. `is_live`:
    what waited for the opening has been fetched."""

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
        if self._window_began_s is None:
            self._window_began_s = t_mono_s
        elif t_mono_s - self._window_began_s > _WINDOW_S:
            self._window_began_s, self._former_s, self._least_s = t_mono_s, self._least_s, math.inf
        self._least_s = min(self._least_s, delay_s)

    def taken_s(self, stamp_s: float, t_mono_s: float) -> float | None:
        """Return the time at which the picture with this stamp was taken, `t_mono_s` at the latest. None while what has
        waited since the opening is still being fetched: how old that is cannot be known."""
        if not self.is_live:
            return None
        return min(t_mono_s, stamp_s + min(self._least_s, self._former_s))

    def _begin_anew(self) -> None:
        self.is_live, self._in_time = False, 0
        self._order_s, self._order_delay_s = -math.inf, math.nan
        self._least_order_delay_s = self._least_s = self._former_s = math.inf
        self._window_began_s: float | None = None


class UnstampedTime:
    """Time for streams without time stamps (MJPEG over HTTP): a picture that was there when it was asked for may have
    come at any moment since the last one that was not."""

    def __init__(self, opened_s: float) -> None:
        self._waited_s = opened_s

    def taken_s(self, asked_s: float, t_mono_s: float) -> float:
        """Return the earliest time at which the picture asked for at `asked_s` and got at `t_mono_s` can have come."""
        if t_mono_s - asked_s > _WAITED_S:
            self._waited_s = t_mono_s
        return self._waited_s
