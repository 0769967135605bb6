"""Estimates when the pictures of a stream were taken, with a standard deviation: from their timestamps
(`StampedTime`), or from the time spent waiting for each (`UnstampedTime`)."""

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

# Standard deviation of the delay from exposure to timestamp (without timestamps: to arrival) in encoder and buffers.
# Nothing in the stream reveals this delay.
HIDDEN_DELAY_SD_S = 0.3

_MAX_DELAY_CHANGE_S = 5.0  # a larger change means that the sender restarted or the stream stalled
_BACKLOG_TOLERANCE_S = 0.005  # a picture whose delay is lower than the minimum so far by more is part of a backlog
_TIMELY_PICTURES = 3  # number of consecutive timely pictures that end a backlog
_MIN_WAIT_S = 0.002  # a picture returned after a shorter wait was already in a buffer
_MEDIAN_WAITS = 9  # number of recent waits whose median is the usual wait
_MAX_WAIT_RATIO = 1.5  # longest normal wait, as a multiple of the usual one
_STEADY_SPAN_S = 5.0
_MAX_STEADY_RANGE_S = 0.2  # delays that vary by less over `_STEADY_SPAN_S` are not due to congestion
_MAX_CLOCK_DRIFT = 1e-4  # largest usual rate error of a clock: 0.01 %
_RATE_SD = 0.01  # standard deviation of an estimated rate: frame-counting cameras change theirs with the light
_CONFIRMING_RANGE_S = 0.02  # a picture whose delay is this close to the minimum confirms it

_UPDATE_PERIOD_S = 0.5
_MAX_PICTURES = 2000  # to keep for the trend search
_SPANS_S = (30.0, 6.0, 2.0, 0.7)  # most recent time spans searched for trends
_MIN_PICTURES = 8  # per span
_MIN_COVERED_FRACTION = 0.8  # of a span, between its first and last picture
_COLUMNS = 5  # arrival, order, stamp, total bytes, delay in excess of the minimum so far
_SECTIONS = 6  # per span; the minimum delay in each is due to the path, not to congestion
_MIN_RISE_S = 0.06  # a smaller change is not a trend
_MAX_RAGGED_FRACTION = 1 / 6  # of the rise: larger residuals from a straight line show congestion, not a trend
_MAX_STRAIGHT_FRACTION = 1 / 10  # if all residuals are smaller, the rate is constant over the span
_MAX_CLOCK_DEPENDENCE = 0.4  # see `bound_size_dependence`: below it a clock is the cause, not a saturated link
_MIN_LINK_DEPENDENCE = 0.55  # above it the link is certainly saturated; large pictures take longer on any link
_YOUNG_STREAM_S = 10.0  # a younger stream has no established rate
_SPAN_AT_START_S = 2.0  # in a young stream, a trend this long shows a rate error
_SPAN_LATER_S = 6.0  # in an older one, whose rate has been right so far, brief congestion is more likely
_MAX_GROWTH = 0.9  # of a delay, in seconds per second; timestamps that almost stand still are useless
_RATE_TOLERANCE = 0.003  # a rate this close to 1 counts as 1
_BOUND_SDS = 3.0
_KEY_PICTURE_RATIO = 2.0  # min ratio of the size of a key frame to the usual size
_PIECES = 3  # of a span, each detrended before delays are compared with sizes
_DOUBT_S = 1.0  # a growing delay may look constant for this long
_MAX_DOUBTFUL_AGE_S = 0.3  # up to this age the standard deviation covers the doubt
_MIN_LOGGED_CHANGE = 0.25

_log = logging.getLogger(__name__)


class CaptureTime(NamedTuple):
    """The time at which a picture was taken, seconds of the monotonic clock, and its standard deviation in seconds."""

    t_s: float
    sd_s: float


class StampedTime:
    """Estimates when pictures were taken, from the stream's timestamps, whose epoch is unknown.

    The delay of a picture is its arrival time minus its stamp. Its age is the excess over the smallest delay so far,
    the minimum. A larger one replaces it only after five seconds of steady delays, as after a pause of the sender; in a
    congested network they vary. `is_live`: all pictures buffered before the opening have been fetched.

    The delay grows if a camera delivers fewer pictures than its stamps claim, or if a link carries less than is sent.
    On a saturated link, large pictures take longer than small ones, and pictures become older. A slow camera sends all
    at equal intervals, so stamps are multiplied by the `rate` estimated from the minimum delays. If neither cause is
    certain, the capture time is unknown."""

    def __init__(self) -> None:
        self._logged_rate = 1.0
        self._reset()

    def _reset(self) -> None:
        self.is_live = False
        self.rate = 1.0  # seconds of our clock per second of the stamps
        self._max_known_age_s = math.inf  # pictures that seem older may be new
        self._timely_count = 0
        self._order_s = -math.inf
        self._arrival_s = self._start_s = self._updated_s = math.nan
        self._confirmed_s = self._steady_check_s = self._last_doubt_s = math.nan
        self._min_order_delay_s = self._min_delay_s = math.inf
        self._scatter_s = 0.0
        self._bytes = 0
        self._window = array("d")  # rows of five, see `_update`

    def record_arrival(self, stamp_s: float, order_s: float, t_mono_s: float, size_bytes: int = 0) -> None:
        """Record the arrival of a picture with the stamp `stamp_s`. `order_s`: its decoding timestamp, which differs
        if pictures are not sent in the order in which they were taken. Times are in seconds."""
        delay_change_s = t_mono_s - self._arrival_s - self.rate * (order_s - self._order_s)
        if order_s < self._order_s or abs(delay_change_s) > _MAX_DELAY_CHANGE_S:
            self._reset()
        if not self._window:
            self._start_s = self._updated_s = self._steady_check_s = self._last_doubt_s = self._arrival_s = t_mono_s
        # Raise the minimum by the maximum drift: otherwise pictures would seem ever older in an unsteady network.
        self._min_delay_s += _MAX_CLOCK_DRIFT * (t_mono_s - self._arrival_s)
        self._min_order_delay_s += _MAX_CLOCK_DRIFT * (t_mono_s - self._arrival_s)
        self._order_s, self._arrival_s = order_s, t_mono_s
        self._bytes += size_bytes
        order_delay_s = t_mono_s - self.rate * order_s
        excess_s = order_delay_s - self._min_order_delay_s
        self._window.extend((t_mono_s, order_s, stamp_s, self._bytes, excess_s))
        self._timely_count = self._timely_count + 1 if excess_s > -_BACKLOG_TOLERANCE_S else 0
        if not self.is_live and self._timely_count >= _TIMELY_PICTURES:
            self.is_live = True
            self._keep_newest(_TIMELY_PICTURES)  # earlier ones arrived all at once
        if t_mono_s - self._updated_s > _UPDATE_PERIOD_S:
            self._updated_s = t_mono_s
            self._update(np.frombuffer(self._window).reshape(-1, _COLUMNS).copy())
        self._min_order_delay_s = min(self._min_order_delay_s, t_mono_s - self.rate * order_s)
        delay_s = t_mono_s - self.rate * stamp_s
        self._min_delay_s = min(self._min_delay_s, delay_s)
        if delay_s - self._min_delay_s < _CONFIRMING_RANGE_S:
            self._confirmed_s = t_mono_s

    def estimate(self, stamp_s: float, t_mono_s: float) -> CaptureTime | None:
        """Return when the picture with the stamp `stamp_s` was taken, not later than its arrival `t_mono_s`. None if
        unknown: pictures buffered before the opening are still being fetched, or the delay is changing and it is
        unclear whether clock drift or congestion is the cause."""
        taken_s = min(t_mono_s, self.rate * stamp_s + self._min_delay_s)
        age_s = t_mono_s - taken_s
        if not self.is_live or age_s > self._max_known_age_s:
            return None
        is_estimated = self.rate != 1.0
        drift_s = (_RATE_SD if is_estimated else _MAX_CLOCK_DRIFT) * max(0.0, t_mono_s - self._confirmed_s)
        if t_mono_s - self._start_s < _SPAN_LATER_S:
            drift_s += _MIN_RISE_S / 2  # a rate error may not be visible yet
        # A camera that stamps pictures by counting them may have taken any of them later than its stamp.
        count_sd_s = age_s / 2 if is_estimated or self._max_known_age_s < math.inf else 0.0
        return CaptureTime(taken_s, math.hypot(FRAME_TIME_SD_S, drift_s, self._scatter_s, count_sd_s))

    def _keep_newest(self, pictures: int) -> None:
        """Drop all but the newest pictures; `pictures` is their number."""
        del self._window[: -pictures * _COLUMNS]

    def _update(self, window: Doubles) -> None:
        """Update rate and delay from the pictures so far, `window` (n, 5), see `_COLUMNS`."""
        arrival_s, order_s, stamp_s, _, _ = window.T
        self._keep_newest(min(_MAX_PICTURES, int(np.count_nonzero(arrival_s > arrival_s[-1] - _SPANS_S[0]))))
        order_delay_s = arrival_s - self.rate * order_s
        is_young = arrival_s[-1] - self._start_s < _YOUNG_STREAM_S
        for span_s in _SPANS_S:
            first = _find_span_start(arrival_s, span_s)
            if first is not None and (trend := fit_envelope_growth(arrival_s[first:], order_delay_s[first:])):
                self._handle_trend(window[first:], *trend, span_s, is_young)
                return
        if arrival_s[-1] - self._last_doubt_s > _DOUBT_S:
            self._max_known_age_s = math.inf
        if (first := _find_span_start(arrival_s, _SPAN_AT_START_S)) is not None:
            excess_s = order_delay_s[first:] - self._min_order_delay_s
            if excess_s.min() > _MAX_DOUBTFUL_AGE_S and np.ptp(excess_s) < _MAX_STEADY_RANGE_S:
                # All are equally late: the sender paused, or the network delays all pictures.
                self._max_known_age_s, self._last_doubt_s = _MAX_DOUBTFUL_AGE_S, arrival_s[-1]
        if arrival_s[-1] - self._steady_check_s > _STEADY_SPAN_S:
            self._steady_check_s = arrival_s[-1]
            first = int(np.searchsorted(arrival_s, arrival_s[-1] - _STEADY_SPAN_S))
            is_steady = np.ptp(order_delay_s[first:]) < _MAX_STEADY_RANGE_S
            if is_steady and bound_size_dependence(window[first:])[0] < _MAX_CLOCK_DEPENDENCE:
                self._min_delay_s = float(np.min((arrival_s - self.rate * stamp_s)[first:]))
                self._min_order_delay_s = float(order_delay_s[first:].min())
                self._max_known_age_s = math.inf

    def _handle_trend(self, window: Doubles, growth: float, is_straight: bool, span_s: float, is_young: bool) -> None:
        """Decide whether a steady change in delay, by `growth` seconds per second, is due to clock drift."""
        arrival_s, order_s, stamp_s, _, excess_s = window.T
        min_dependence, max_dependence = bound_size_dependence(window)
        if growth > 0:
            min_span_s = _SPAN_AT_START_S if is_young else _SPAN_LATER_S
            is_congested = _MIN_LINK_DEPENDENCE < min_dependence < 1 / _MIN_LINK_DEPENDENCE
            max_known_age_s = _MAX_DOUBTFUL_AGE_S
        else:
            # As congestion clears, each picture arrives with less delay than the one before, down to the minimum.
            min_span_s = _SPAN_AT_START_S if self.is_live else _SPAN_LATER_S
            is_congested = excess_s[: len(excess_s) // 2].min() > _CONFIRMING_RANGE_S
            max_known_age_s = -1.0
        self._max_known_age_s = math.inf
        if is_congested:
            return
        is_clock = max_dependence < _MAX_CLOCK_DEPENDENCE and is_straight and span_s >= min_span_s
        if not is_clock or growth > _MAX_GROWTH:
            self._max_known_age_s, self._last_doubt_s = max_known_age_s, arrival_s[-1]
            return
        rate = self.rate / (1 - growth)
        self.rate = 1.0 if abs(rate - 1) < _RATE_TOLERANCE else rate
        self.is_live = True
        self._keep_newest(len(window))
        self._min_delay_s = float(np.min(arrival_s - self.rate * stamp_s))
        order_delay_s = arrival_s - self.rate * order_s
        self._min_order_delay_s = float(order_delay_s.min())
        self._scatter_s = 0.0 if self.rate == 1.0 else float(np.median(order_delay_s) - self._min_order_delay_s)
        if abs(self.rate / self._logged_rate - 1) > _MIN_LOGGED_CHANGE:
            self._logged_rate = self.rate
            _log.warning("the stream's timestamps run at %.2f times the true rate: correcting them", 1 / self.rate)


def _find_span_start(arrival_s: Doubles, span_s: float) -> int | None:
    """Return the index of the first picture in the last `span_s` seconds; None if pictures cover too little of them."""
    first = min(int(np.searchsorted(arrival_s, arrival_s[-1] - span_s)), max(0, len(arrival_s) - _MIN_PICTURES))
    return first if arrival_s[-1] - arrival_s[first] > _MIN_COVERED_FRACTION * span_s else None


def fit_envelope_growth(arrival_s: Doubles, delay_s: Doubles) -> tuple[float, bool] | None:
    """Return the growth of the minimum delays, in seconds per second, and whether it is very close to linear; None if
    they do not change linearly. `arrival_s` (n,): arrival times; `delay_s` (n,): delays, both in seconds."""
    starts = np.searchsorted(arrival_s, np.linspace(arrival_s[0], arrival_s[-1], _SECTIONS + 1))
    if len(arrival_s) < _MIN_PICTURES or not np.diff(starts).all():
        return None
    lowest = [int(start + np.argmin(delay_s[start:end])) for start, end in pairwise(starts)]
    x_s, y_s = arrival_s[lowest] - arrival_s[lowest].mean(), delay_s[lowest] - delay_s[lowest].mean()
    growth = x_s @ y_s / (x_s @ x_s)
    residual_s = np.abs(y_s - growth * x_s).max()
    rise_s = abs(growth) * (arrival_s[-1] - arrival_s[0])
    if rise_s < _MIN_RISE_S or residual_s > _MAX_RAGGED_FRACTION * rise_s:
        return None
    return float(growth), bool(residual_s < _MAX_STRAIGHT_FRACTION * rise_s)


def bound_size_dependence(window: Doubles) -> tuple[float, float]:
    """Return a lower and an upper bound on how strongly the interval between two pictures depends on their size (1: as
    on a saturated link, 0: not at all). `window` (n, 5): see `_COLUMNS`."""
    steps = np.diff(window[:, [0, 1, 3]], axis=0)
    if len(steps) < 3 * _PIECES or steps[:, 2].sum() <= 0:
        return -math.inf, math.inf
    # A link's capacity changes, so each step is compared with those around it.
    pieces = np.array_split(steps, _PIECES)
    excess_s, size_excess_s = np.concatenate([_subtract_expected(*piece.T) for piece in pieces], axis=1)
    slope, sd = _fit_slope(excess_s, size_excess_s)
    # A large picture that arrived just before or after a change must not outweigh all the others.
    is_usual = steps[:, 2] <= _KEY_PICTURE_RATIO * np.median(steps[:, 2])
    usual_slope, usual_sd = _fit_slope(excess_s[is_usual], size_excess_s[is_usual])
    lower_bound = max(slope - _BOUND_SDS * sd, usual_slope - _BOUND_SDS * usual_sd)
    return lower_bound, max(abs(slope) + _BOUND_SDS * sd, usual_slope - usual_sd)


def _fit_slope(y: Doubles, x: Doubles) -> tuple[float, float]:
    """Return the slope of the regression of `y` (n,) on `x` (n,), and its standard deviation."""
    y, x = y - y.mean(), x - x.mean()
    sum_sq = float(x @ x)
    if len(x) < 3 * _PIECES or sum_sq < 1e-9:
        return 0.0, math.inf
    slope = float(y @ x) / sum_sq
    residuals = y - slope * x
    return slope, math.sqrt(float(residuals @ residuals) / (len(x) - _PIECES - 1) / sum_sq)


def _subtract_expected(arrival_s: Doubles, order_s: Doubles, size: Doubles) -> Doubles:
    """Return the excess of each step over that predicted from stamps, seconds (2, n): measured, and from its size."""
    total_s = arrival_s.sum()
    from_stamps_s = order_s * (total_s / order_s.sum()) if order_s.sum() else np.full_like(arrival_s, arrival_s.mean())
    from_size_s = size * (total_s / size.sum()) if size.sum() else from_stamps_s
    return np.stack((arrival_s - from_stamps_s, from_size_s - from_stamps_s))


class UnstampedTime:
    """Estimates when pictures were taken, for streams without timestamps (MJPEG over HTTP). Only the time spent
    waiting for each picture is known.

    After a wait of the usual length, the picture has just arrived. After a longer wait, it may have been delayed in
    transit by up to that wait. A picture returned without a wait arrived in a buffer after the last wait ended."""

    def __init__(self, opened_s: float) -> None:
        self._earliest_s = opened_s
        self._waits_s: deque[float] = deque(maxlen=_MEDIAN_WAITS)

    def estimate(self, request_s: float, t_mono_s: float) -> CaptureTime:
        """Return the earliest possible arrival time of a picture that was requested at `request_s` and returned at
        `t_mono_s` (seconds, monotonic). All times from then to `t_mono_s` are equally likely."""
        wait_s = t_mono_s - request_s
        if wait_s > _MIN_WAIT_S:
            usual_s = median(self._waits_s) if len(self._waits_s) == _MEDIAN_WAITS else 0.0
            self._earliest_s = t_mono_s if wait_s <= _MAX_WAIT_RATIO * usual_s else request_s
            self._waits_s.append(wait_s)
        return CaptureTime(self._earliest_s, math.hypot(FRAME_TIME_SD_S, (t_mono_s - self._earliest_s) / math.sqrt(3)))
