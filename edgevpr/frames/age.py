"""The time at which pictures of a stream were taken, by their time stamps (`StampedTime`) or by how long each has been
waited for (`UnstampedTime`), and how well it is known."""

import logging
import math
from array import array
from collections import deque
from itertools import pairwise
from statistics import median
from typing import NamedTuple

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.types import FRAME_TIME_SD_S

# Standard deviation of a hidden delay: from the light to the stamp, or where there is none to the arrival, an encoder
# and its buffer take so long, which nothing in the stream shows.
HIDDEN_DELAY_SD_S = 0.3

_MAX_DELAY_CHANGE_S = 5.0  # a larger change of the delay: the sender has restarted, or something has held the stream up
_BACKLOG_TOLERANCE_S = 0.005  # a picture with a delay shorter than the least so far by more than this was in a backlog
_TIMELY_PICTURES = 3  # pictures in a row not in a backlog after which there is none any more
_MIN_WAIT_S = 0.002  # a picture that was returned sooner than this was in a buffer already
_MEDIAN_WAITS = 9  # number of waits whose median is the usual one
_MAX_WAIT_RATIO = 1.5  # multiple of the usual wait that is normal
_STEADY_SPAN_S = 5.0
_MAX_STEADY_RANGE_S = 0.2  # delays that vary by less in `_STEADY_SPAN_S` are due to the path, and not to congestion
_MAX_CLOCK_DRIFT = 1e-4  # largest usual error of the rate of a clock: 0.01 %
_RATE_SD = 0.01  # standard deviation of a rate that was estimated: cameras that count change theirs with the light
_CONFIRMING_RANGE_S = 0.02  # a picture with a delay so near to the least confirms it

_UPDATE_PERIOD_S = 0.5
_MAX_PICTURES = 2000  # kept to find a trend
_SPANS_S = (30.0, 6.0, 2.0, 0.7)  # in which a trend is looked for
_MIN_PICTURES = 8  # of a span
_MIN_COVERED_SHARE = 0.8  # of a span, from the first picture to the last
_COLUMNS = 5  # arrival, order, stamp, sum of bytes, delay above the least then
_SECTIONS = 6  # of a span; the least delay of each is that of the path alone
_MIN_RISE_S = 0.06  # less is no trend
_MAX_RAGGED_SHARE = 1 / 6  # of the rise: sections that are farther from a straight line are no trend but congestion
_MAX_STRAIGHT_SHARE = 1 / 10  # with sections that are nearer, all of the span has the same rate
_MAX_CLOCK_SHARE = 0.4  # share of the bytes that a clock is below, and a full link above
_MIN_LINK_SHARE = 0.55  # share above which a link is certainly full: large pictures take their time in others too
_YOUNG_STREAM_S = 10.0  # a stream that is younger has no usual rate
_SPAN_AT_START_S = 2.0  # that shows another rate, and
_SPAN_LATER_S = 6.0  # for a stream that kept the right one before: a short congestion is likelier
_MAX_GROWTH = 0.9  # of a delay, per second: stamps that nearly stand still give no time
_RATE_TOLERANCE = 0.003  # a rate nearer to one is one
_BOUND_SDS = 3.0
_KEY_PICTURE_RATIO = 2.0  # times the usual size: a key picture
_PIECES = 3  # of a span, whose trends are taken out of a comparison with the bytes
_DOUBT_S = 1.0  # longer than a delay that grows may seem not to
_MAX_DOUBTFUL_AGE_S = 0.3  # up to this the doubt is part of the standard deviation
_MIN_LOGGED_CHANGE = 0.25

_log = logging.getLogger(__name__)


class CaptureTime(NamedTuple):
    """The time at which a picture was taken, seconds of the monotonic clock, and its standard deviation in seconds."""

    t_s: float
    sd_s: float


class StampedTime:
    """Estimates when pictures were taken, from the stream's time stamps, which count from an unknown zero.

    The delay of a picture is its arrival time minus its stamp. One with a longer delay than the least so far is older
    by the difference. A larger value replaces the least delay only if delays have been steady for five seconds, as
    after a pause of the sender; in a congested network they vary. `is_live`: the pictures that were buffered before the
    opening have been fetched.

    A camera that delivers fewer pictures than its stamps say makes the delay grow, and so does a link that carries less
    than is sent. But in a full link a large picture takes longer than a small one, and pictures get older; from a
    camera, all come at the same intervals, and stamps are multiplied by the `rate` that the least delays show. Where
    neither is certain, the time is unknown."""

    def __init__(self) -> None:
        self._logged_rate = 1.0
        self._begin_anew()

    def _begin_anew(self) -> None:
        self.is_live = False
        self.rate = 1.0  # seconds of our clock that pass in one second of the stamps
        self._max_known_age_s = math.inf  # a picture that seems older may be a new one
        self._in_time = 0
        self._order_s = -math.inf
        self._came_s = self._begun_s = self._judged_s = self._confirmed_s = self._settled_s = self._doubted_s = math.nan
        self._least_order_delay_s = self._least_s = math.inf
        self._scatter_s = 0.0
        self._bytes = 0
        self._seen = array("d")  # rows of five, see `_judge`

    def record_arrival(self, stamp_s: float, order_s: float, t_mono_s: float, size_bytes: int = 0) -> None:
        """Record the arrival of a picture with the stamp `stamp_s`. `order_s`: its decoding time stamp, which differs
        in streams that send pictures in another order than they were taken. All in seconds."""
        held_up_s = t_mono_s - self._came_s - self.rate * (order_s - self._order_s)
        if order_s < self._order_s or abs(held_up_s) > _MAX_DELAY_CHANGE_S:
            self._begin_anew()
        if not self._seen:
            self._begun_s = self._judged_s = self._settled_s = self._doubted_s = self._came_s = t_mono_s
        self._leak(t_mono_s - self._came_s)
        self._order_s, self._came_s = order_s, t_mono_s
        self._bytes += size_bytes
        order_delay_s = t_mono_s - self.rate * order_s
        above_s = order_delay_s - self._least_order_delay_s
        self._seen.extend((t_mono_s, order_s, stamp_s, self._bytes, above_s))
        self._in_time = self._in_time + 1 if above_s > -_BACKLOG_TOLERANCE_S else 0
        if not self.is_live and self._in_time >= _TIMELY_PICTURES:
            self.is_live = True
            self._keep(_TIMELY_PICTURES)  # those before came all at once
        if t_mono_s - self._judged_s > _UPDATE_PERIOD_S:
            self._judged_s = t_mono_s
            self._judge(np.frombuffer(self._seen).reshape(-1, _COLUMNS).copy())
        self._least_order_delay_s = min(self._least_order_delay_s, t_mono_s - self.rate * order_s)
        delay_s = t_mono_s - self.rate * stamp_s
        self._least_s = min(self._least_s, delay_s)
        if delay_s - self._least_s < _CONFIRMING_RANGE_S:
            self._confirmed_s = t_mono_s

    def taken(self, stamp_s: float, t_mono_s: float) -> CaptureTime | None:
        """Return when the picture with the stamp `stamp_s` was taken, at most its arrival `t_mono_s`. None while this
        is unknown: pictures that were buffered before the opening are still being fetched, or the delay changes, and it
        is not known whether that is a clock's rate or congestion."""
        taken_s = min(t_mono_s, self.rate * stamp_s + self._least_s)
        age_s = t_mono_s - taken_s
        if not self.is_live or age_s > self._max_known_age_s:
            return None
        is_estimated = self.rate != 1.0
        drift_s = (_RATE_SD if is_estimated else _MAX_CLOCK_DRIFT) * max(0.0, t_mono_s - self._confirmed_s)
        if t_mono_s - self._begun_s < _SPAN_LATER_S:
            drift_s += _MIN_RISE_S / 2  # another rate may not have shown yet
        # A camera that counts may have taken any of its pictures later than its stamps say.
        is_uncertain = is_estimated or self._max_known_age_s < math.inf
        return CaptureTime(
            taken_s, math.hypot(FRAME_TIME_SD_S, drift_s, self._scatter_s, age_s / 2 if is_uncertain else 0.0)
        )

    def _keep(self, pictures: int) -> None:
        """Forget all but the last so many pictures."""
        del self._seen[: -pictures * _COLUMNS]

    def _leak(self, passed_s: float) -> None:
        """Let the least delay grow as by a slow clock: a network that is never steady would age pictures for ever."""
        self._least_s += _MAX_CLOCK_DRIFT * passed_s
        self._least_order_delay_s += _MAX_CLOCK_DRIFT * passed_s

    def _judge(self, window: Doubles) -> None:
        """Find out what the pictures so far, (n, 5) arrival, order, stamp, sum of bytes and delay above the least then,
        say of rate and delay."""
        came_s, order_s, stamp_s, _, _ = window.T
        self._keep(min(_MAX_PICTURES, int(np.count_nonzero(came_s > came_s[-1] - _SPANS_S[0]))))
        order_delay_s = came_s - self.rate * order_s
        is_new = came_s[-1] - self._begun_s < _YOUNG_STREAM_S
        for span_s in _SPANS_S:
            first = _find_span_start(came_s, span_s)
            if first is not None and (trend := fit_envelope_growth(came_s[first:], order_delay_s[first:])):
                self._follow_trend(window[first:], *trend, span_s, is_new)
                return
        if came_s[-1] - self._doubted_s > _DOUBT_S:
            self._max_known_age_s = math.inf
        if (first := _find_span_start(came_s, _SPAN_AT_START_S)) is not None:
            above_s = order_delay_s[first:] - self._least_order_delay_s
            if above_s.min() > _MAX_DOUBTFUL_AGE_S and np.ptp(above_s) < _MAX_STEADY_RANGE_S:
                # All are late by the same: so the sender has paused, or the network holds all of them up.
                self._max_known_age_s, self._doubted_s = _MAX_DOUBTFUL_AGE_S, came_s[-1]
        if came_s[-1] - self._settled_s > _STEADY_SPAN_S:
            self._settled_s = came_s[-1]
            first = int(np.searchsorted(came_s, came_s[-1] - _STEADY_SPAN_S))
            if (
                np.ptp(order_delay_s[first:]) < _MAX_STEADY_RANGE_S
                and bound_bytes_share(window[first:])[0] < _MAX_CLOCK_SHARE
            ):
                self._least_s = float(np.min((came_s - self.rate * stamp_s)[first:]))
                self._least_order_delay_s = float(order_delay_s[first:].min())
                self._max_known_age_s = math.inf

    def _follow_trend(self, window: Doubles, growth: float, is_straight: bool, span_s: float, is_new: bool) -> None:
        """Decide what a delay means that has changed steadily by `growth` seconds per second, in these pictures."""
        came_s, order_s, stamp_s, _, above_s = window.T
        least_share, most_share = bound_bytes_share(window)
        if growth > 0:
            needed_s = _SPAN_AT_START_S if is_new else _SPAN_LATER_S
            is_congested = _MIN_LINK_SHARE < least_share < 1 / _MIN_LINK_SHARE
            max_known_age_s = _MAX_DOUBTFUL_AGE_S
        else:
            # Pictures that come ever sooner after a congestion are less old each, until the least delay is reached.
            needed_s = _SPAN_AT_START_S if self.is_live else _SPAN_LATER_S
            is_congested = above_s[: len(above_s) // 2].min() > _CONFIRMING_RANGE_S
            max_known_age_s = -1.0
        self._max_known_age_s = math.inf
        if is_congested:
            return
        is_of_clock = most_share < _MAX_CLOCK_SHARE and is_straight and span_s >= needed_s
        if not is_of_clock or growth > _MAX_GROWTH:
            self._max_known_age_s, self._doubted_s = max_known_age_s, came_s[-1]
            return
        rate = self.rate / (1 - growth)
        self.rate = 1.0 if abs(rate - 1) < _RATE_TOLERANCE else rate
        self.is_live = True
        self._keep(len(window))
        self._least_s = float(np.min(came_s - self.rate * stamp_s))
        order_delay_s = came_s - self.rate * order_s
        self._least_order_delay_s = float(order_delay_s.min())
        self._scatter_s = 0.0 if self.rate == 1.0 else float(np.median(order_delay_s) - self._least_order_delay_s)
        if abs(self.rate / self._logged_rate - 1) > _MIN_LOGGED_CHANGE:
            self._logged_rate = self.rate
            _log.warning("the stream's time stamps run at %.2f of the true rate: they are corrected", 1 / self.rate)


def _find_span_start(came_s: Doubles, span_s: float) -> int | None:
    """Return the first picture of the last `span_s` seconds; None if there are none from most of them, or too few."""
    first = min(int(np.searchsorted(came_s, came_s[-1] - span_s)), max(0, len(came_s) - _MIN_PICTURES))
    return first if came_s[-1] - came_s[first] > _MIN_COVERED_SHARE * span_s else None


def fit_envelope_growth(came_s: Doubles, delay_s: Doubles) -> tuple[float, bool] | None:
    """Return by how many seconds per second the least delays of pictures grow, and whether in a very straight line.
    None if they do not change in a line. `came_s` (n,): arrival times; `delay_s` (n,): delays, both in seconds."""
    begins = np.searchsorted(came_s, np.linspace(came_s[0], came_s[-1], _SECTIONS + 1))
    if len(came_s) < _MIN_PICTURES or not np.diff(begins).all():
        return None
    lowest = [int(begin + np.argmin(delay_s[begin:end])) for begin, end in pairwise(begins)]
    x_s, y_s = came_s[lowest] - came_s[lowest].mean(), delay_s[lowest] - delay_s[lowest].mean()
    growth = x_s @ y_s / (x_s @ x_s)
    ragged_s = np.abs(y_s - growth * x_s).max()
    rise_s = abs(growth) * (came_s[-1] - came_s[0])
    if rise_s < _MIN_RISE_S or ragged_s > _MAX_RAGGED_SHARE * rise_s:
        return None
    return float(growth), bool(ragged_s < _MAX_STRAIGHT_SHARE * rise_s)


def bound_bytes_share(window: Doubles) -> tuple[float, float]:
    """Return between which bounds is the share to which the time between two pictures depends on their bytes (1: as in
    a full link, 0: not at all). `window` (n, 5): arrival, order, stamp, sum of bytes, and one that is not used."""
    steps = np.diff(window[:, [0, 1, 3]], axis=0)
    if len(steps) < 3 * _PIECES or steps[:, 2].sum() <= 0:
        return -math.inf, math.inf
    # A link's capacity changes. So the steps are compared with those around them.
    pieces = np.array_split(steps, _PIECES)
    late_s, by_bytes_s = np.concatenate([_subtract_expected(*piece.T) for piece in pieces], axis=1)
    share, sd = _fit_slope(late_s, by_bytes_s)
    # A large picture that came just before or after a change must not outweigh all the others.
    is_usual = steps[:, 2] <= _KEY_PICTURE_RATIO * np.median(steps[:, 2])
    usual, sd_of_usual = _fit_slope(late_s[is_usual], by_bytes_s[is_usual])
    least = max(share - _BOUND_SDS * sd, usual - _BOUND_SDS * sd_of_usual)
    return least, max(abs(share) + _BOUND_SDS * sd, usual - sd_of_usual)


def _fit_slope(y: Doubles, x: Doubles) -> tuple[float, float]:
    """Return the factor of `x` (n,) that gives `y` (n,) but for an offset, and its standard deviation."""
    y, x = y - y.mean(), x - x.mean()
    power = float(x @ x)
    if len(x) < 3 * _PIECES or power < 1e-9:
        return 0.0, math.inf
    factor = float(y @ x) / power
    rest = y - factor * x
    return factor, math.sqrt(float(rest @ rest) / (len(x) - _PIECES - 1) / power)


def _subtract_expected(came_s: Doubles, order_s: Doubles, size: Doubles) -> Doubles:
    """Return by how much each step is longer than it would be by the stamps, and by how much it should be by its bytes,
    (2, n) in seconds."""
    whole_s = came_s.sum()
    by_stamps_s = order_s * (whole_s / order_s.sum()) if order_s.sum() else np.full_like(came_s, came_s.mean())
    by_bytes_s = size * (whole_s / size.sum()) if size.sum() else by_stamps_s
    return np.stack((came_s - by_stamps_s, by_bytes_s - by_stamps_s))


class UnstampedTime:
    """Estimates when pictures were taken, for streams without time stamps (MJPEG over HTTP). Only the time spent
    waiting for each picture is known.

    After a wait of usual length, the picture has just arrived. After a longer wait it may have been delayed on its way,
    by as much as the wait. A picture returned without any wait was in a buffer, at most since the last wait ended."""

    def __init__(self, opened_s: float) -> None:
        self._since_s = opened_s
        self._waits_s: deque[float] = deque(maxlen=_MEDIAN_WAITS)

    def taken(self, asked_s: float, t_mono_s: float) -> CaptureTime:
        """Return the earliest time at which the picture can have arrived whose fetch began at `asked_s` and ended at
        `t_mono_s`, seconds of the monotonic clock. Each time up to `t_mono_s` is as likely."""
        wait_s = t_mono_s - asked_s
        if wait_s > _MIN_WAIT_S:
            usual_s = median(self._waits_s) if len(self._waits_s) == _MEDIAN_WAITS else 0.0
            self._since_s = t_mono_s if wait_s <= _MAX_WAIT_RATIO * usual_s else asked_s
            self._waits_s.append(wait_s)
        return CaptureTime(self._since_s, math.hypot(FRAME_TIME_SD_S, (t_mono_s - self._since_s) / math.sqrt(3)))
