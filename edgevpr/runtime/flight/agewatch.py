"""Estimates the hidden delay of frames: how much older they are than their timestamps, because of an encoder or a
buffer before the timestamp. Only the aircraft's own motion reveals it.

Accepted matches are compared with the motion that the autopilot reports. In turns and at changes of speed, a delay
shifts and rotates each match as neither wind nor a compass error does. A known delay is subtracted from the time of
each frame. If the delay changes suddenly, the age of frames is unknown, and none is used until the old delay returns or
the new one is known. In straight flight at constant speed, matches do not show a constant delay: then the claimed error
includes the delay that is usual for the kind of camera (`Frame.delay_sd_s`).
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import offset_between_m, wrap_deg
from edgevpr.core.types import FRAME_TIME_SD_S, Frame, Position
from edgevpr.runtime.recognise.recognition import Recognition

DELAYS_S = np.arange(-1.0, 6.05, 0.1)  # candidates

_HISTORY_S = 60.0  # of motion and matches
_MAX_MOTION_GAP_S = 1.0  # between two reports
_MIN_INTERVAL_S = 0.9  # between two matches: an earlier one adds no information
_MAX_MATCHES = 20
_MIN_MATCHES = 4  # needed to estimate a delay
# Largest chi-square of a delay under the prior, the usual delay of such a camera, since a delay of seconds is possible.
# For a negative delay the deviation is multiplied by this factor, without a limit, because such delays are rare.
_MAX_PRIOR_CHI2 = 30.0
_NEGATIVE_FACTOR = 4.0
_START_SD_M = 1e3
_MATCH_SD_M = 1.5
# Of reported headings minus those of matches, due to compass and mount.
_HEADING_RANDOM_WALK_DEG = 0.3
_DIRECTION_SD_DEG = 2.0
_HEADING_OFFSET_GAIN = 0.25
_UNKNOWN_HEADING_OFFSET = 0.0, 30.0
# A match contradicts the current delay if another one fits far better, and agrees with it if no other fits: chi-square
# with three degrees of freedom. When a stream is reopened, its delay may change by 0.5 s; one that differs by 1.5 s
# is a different delay.
_CONTRADICTION_CHI2 = 14.0
_MIN_GAIN_CHI2 = 10.0
_AGREEMENT_CHI2 = 9.0
_MIN_LEAD_CHI2 = 6.0
_MAX_DELAY_CHANGE_S = 0.5
_MIN_OTHER_DELAY_S = 1.5
_MAX_COMPARED = 12  # number of earlier matches that a match is compared with
_MAX_DELAY_SD_S = 0.3  # of a known delay
_MAX_CHI2_PER_MATCH = 3.0  # if all have the same delay
_MIN_PENDING_MATCHES = 8  # needed to accept another delay
_PAST_CHI2_WEIGHT = 0.9  # of the matches before the last half minute
_MIN_AGREEING = 2  # consecutive matches after which the old delay counts as confirmed
_MAX_OUTLIERS = 3  # consecutive contradictions that no delay explains: then the reported motion is wrong


@dataclass(frozen=True, slots=True)
class VelocityError:
    """Error of a reported velocity: standard deviation (m/s), and random walk (m/s in one second)."""

    sd_m_s: float
    random_walk_m_s: float


GPS_ERROR = VelocityError(0.2, 0.05)
DEAD_RECKONING_ERROR = VelocityError(8.0, 0.5)  # unknown wind
# Accelerations rotated by the attitude of a PX4 that follows our positions: it was wrong by up to five degrees.
PX4_INERTIAL_ERROR = VelocityError(8.0, 2.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedMatch:
    """An accepted match of a frame with the timestamp `t_s`: the aircraft's position, metres east and north, its
    standard deviation `sd_m`, and its heading (NaN: unknown). `delay_s`: the delay of this match, if it differs from
    that of the others (None: it does not)."""

    t_s: float
    east_m: float
    north_m: float
    heading_deg: float
    sd_m: float
    delay_s: float | None = None


@dataclass(frozen=True, slots=True)
class Delay:
    """A hidden delay and its standard deviation, seconds."""

    s: float
    sd_s: float


class Comparison(Enum):
    """Comparison of a match with the delay of earlier ones. UNKNOWN: several delays fit. OUTLIER: none fits."""

    AGREES = auto()
    UNKNOWN = auto()
    OTHER_DELAY = auto()
    OUTLIER = auto()


class AgeWatch:
    """Estimates the hidden delay of the frames of one camera. `is_unknown`: their age is unknown at present."""

    def __init__(self) -> None:
        self.is_unknown = False
        # Reports: time, position, heading and velocity; growth of the velocity's variance, and its initial variance.
        self._motion: deque[tuple[float, ...]] = deque()
        self._origin: Position | None = None
        self._matches: list[TimedMatch] = []
        self._pending: list[TimedMatch] = []  # since the age became unknown
        self._delay: Delay | None = None
        self._past_chi2, self._past_until_s = np.zeros(len(DELAYS_S)), -math.inf  # from matches until then
        self._heading_offset_deg, self._heading_offset_s = math.nan, 0.0  # matches minus reports; last update
        self._prior_sd_s, self._applied_delay_s = FRAME_TIME_SD_S, 0.0
        self._agreeing = self._outliers = 0

    @property
    def delay_s(self) -> float:
        """The delay to subtract, seconds; 0 if none is known, or if images seem to be newer than their times: a camera
        that looks ahead of straight down looks so too, and its mount is measured only at the right times."""
        return self._delay.s if self._delay and self._delay.s > 2 * self._delay.sd_s else 0.0

    def add_motion(self, t_s: float, velocity_m_s: Doubles, heading_deg: float | None, error: VelocityError) -> None:
        """Add the reported motion at `t_s`: velocity (2,), east and north, with its error, and heading."""
        if self._motion and t_s <= self._motion[-1][0]:
            return
        if self._motion and t_s - self._motion[-1][0] > _MAX_MOTION_GAP_S:
            self._motion.clear()
            self._matches, self._pending = [], []
        heading_deg = math.nan if heading_deg is None else heading_deg
        east_m_s, north_m_s = map(float, velocity_m_s)
        east_m, north_m, growth_m2_s2 = 0.0, 0.0, 0.0
        start_m2_s2 = error.sd_m_s**2
        if self._motion:
            last_s, east_m, north_m, last_heading_deg, last_east_m_s, last_north_m_s, _, last_m2_s2 = self._motion[-1]
            interval_s = t_s - last_s
            east_m += interval_s / 2 * (last_east_m_s + east_m_s)
            north_m += interval_s / 2 * (last_north_m_s + north_m_s)
            growth_m2_s2 = interval_s * error.random_walk_m_s**2 + abs(start_m2_s2 - last_m2_s2)
            if math.isfinite(last_heading_deg):
                heading_deg = last_heading_deg + float(wrap_deg(heading_deg - last_heading_deg))  # unwrapped
        self._motion.append((t_s, east_m, north_m, heading_deg, east_m_s, north_m_s, growth_m2_s2, start_m2_s2))
        while t_s - self._motion[0][0] > _HISTORY_S + DELAYS_S[-1]:
            self._motion.popleft()

    def correct(self, frame: Frame) -> Frame:
        """Return a frame with its time corrected by the delay, and the error of the delay in `t_sd_s`."""
        self._prior_sd_s, self._applied_delay_s = frame.delay_sd_s, self.delay_s
        delay = self._delay or Delay(0.0, frame.delay_sd_s)
        sd_s = math.hypot(delay.sd_s, delay.s - self._applied_delay_s)
        return replace(frame, t_mono_s=frame.t_mono_s - self._applied_delay_s, t_sd_s=math.hypot(frame.t_sd_s, sd_s))

    def judge(self, event: Recognition) -> None:
        """Process the accepted match of the frame that `correct` returned last. If `is_unknown` is True afterwards, the
        match must not be used."""
        # Matches older than the stored motion cannot be compared with it.
        from_s = self._motion[0][0] + DELAYS_S[-1] if self._motion else math.inf
        self._matches = [match for match in self._matches if match.t_s >= from_s]
        self._pending = [match for match in self._pending if match.t_s >= from_s][-_MAX_MATCHES:]
        match = self._make_match(event)
        if match is None:
            return
        comparison, match_delay = self._compare(match)
        self._agreeing = self._agreeing + 1 if comparison is Comparison.AGREES else 0
        self._outliers = self._outliers + 1 if comparison is Comparison.OUTLIER else 0
        self.is_unknown |= comparison is Comparison.OTHER_DELAY
        if self.is_unknown:
            self._pending.append(match)
            if match_delay and match_delay.sd_s < _MAX_DELAY_CHANGE_S and comparison is not Comparison.OUTLIER:
                self._matches = [*self._matches[1 - _MAX_MATCHES :], replace(match, delay_s=match_delay.s)]
            self._resume()
        elif self._outliers == _MAX_OUTLIERS:
            self._matches, self._outliers = [match], 0
        elif not self._outliers and (not self._matches or match.t_s - self._matches[-1].t_s >= _MIN_INTERVAL_S):
            self._matches = [*self._matches[1 - _MAX_MATCHES :], match]
            self._update_delay(match.t_s)
            self._update_heading_offset(match)

    def _update_delay(self, now_s: float) -> None:
        """Estimate the delay again after a new match."""
        new = [match for match in self._matches if match.t_s > self._past_until_s and match.delay_s is None]
        if len(new) < _MIN_MATCHES:
            return
        chi2 = self._past_chi2 + self._compute_chi2(new, np.tile(DELAYS_S[:, None], len(new)))
        if chi2.min() > _MAX_CHI2_PER_MATCH * len(new):
            return
        sigmas = DELAYS_S / self._prior_sd_s
        prior = np.where(sigmas < 0, (_NEGATIVE_FACTOR * sigmas) ** 2, np.minimum(sigmas**2, _MAX_PRIOR_CHI2))
        self._delay = _estimate_delay(chi2 + prior)
        if now_s - new[0].t_s > _HISTORY_S / 2 or len(new) == _MAX_MATCHES:
            self._past_until_s, self._past_chi2 = now_s, _PAST_CHI2_WEIGHT * (chi2 - chi2.min())

    def _update_heading_offset(self, match: TimedMatch) -> None:
        """Update the mean heading of matches minus that of the compass, while the delay is the usual one."""
        times_s, _, _, headings_deg, *_ = np.array(self._motion).T
        exposure_s = match.t_s - (self._delay.s if self._delay else 0.0)
        offset_deg = float(wrap_deg(match.heading_deg - np.interp(exposure_s, times_s, headings_deg)))
        if math.isfinite(offset_deg):
            last_deg = self._heading_offset_deg if math.isfinite(self._heading_offset_deg) else offset_deg
            self._heading_offset_deg = last_deg + _HEADING_OFFSET_GAIN * float(wrap_deg(offset_deg - last_deg))
            self._heading_offset_s = match.t_s

    def _resume(self) -> None:
        """Use frames again if the old delay is confirmed, or the new one is known."""
        if self._agreeing >= _MIN_AGREEING:
            self._pending, self.is_unknown = [], False
        if len(self._pending) < _MIN_PENDING_MATCHES:
            return
        chi2 = self._compute_chi2(self._pending, np.tile(DELAYS_S[:, None], len(self._pending)))
        estimate = _estimate_delay(chi2)
        is_clear = chi2.min() < _MAX_CHI2_PER_MATCH * len(self._pending) and estimate.sd_s < _MAX_DELAY_SD_S
        if is_clear and estimate.s > -_MAX_DELAY_CHANGE_S:
            self._matches, self._pending, self._delay, self.is_unknown = self._pending, [], estimate, False
            self._past_until_s, self._past_chi2 = -math.inf, np.zeros(len(DELAYS_S))

    def _make_match(self, event: Recognition) -> TimedMatch | None:
        """Return the match of an event; None if the motion at that time is not known."""
        located, frame = event.located, event.frame
        if located is None or frame is None or not self._motion:
            return None
        t_s, position = frame.t_mono_s + self._applied_delay_s, located.position
        if not self._motion[0][0] <= t_s - DELAYS_S[-1] <= t_s <= self._motion[-1][0] + _MAX_MOTION_GAP_S:
            return None
        self._origin = self._origin or position
        east_m, north_m = offset_between_m(self._origin, position)
        heading_deg = math.nan
        if located.heading_deg is not None and event.view.up_deg is not None:
            times_s, _, _, headings_deg, *_ = np.array(self._motion).T
            rotation_deg = wrap_deg(located.heading_deg - event.view.up_deg)
            heading_deg = float(np.interp(frame.t_mono_s, times_s, headings_deg) + rotation_deg)
        sd_m = math.hypot(located.sd_m, _MATCH_SD_M)
        return TimedMatch(t_s=t_s, east_m=float(east_m), north_m=float(north_m), heading_deg=heading_deg, sd_m=sd_m)

    def _compare(self, match: TimedMatch) -> tuple[Comparison, Delay | None]:
        """Compare a match with the delay of the earlier ones; also return its own delay (None: none fits)."""
        earlier = self._matches[-_MAX_COMPARED:]
        if self._delay is None or len(earlier) < _MIN_MATCHES:
            return Comparison.UNKNOWN, None
        usual_s = self._delay.s
        earlier_delays_s = [usual_s if match.delay_s is None else match.delay_s for match in earlier]
        delays_s = np.tile(earlier_delays_s, (len(DELAYS_S), 1))
        elapsed_s = max(0.0, earlier[0].t_s - self._heading_offset_s)
        sd_deg = math.hypot(_DIRECTION_SD_DEG, _HEADING_RANDOM_WALK_DEG * math.sqrt(elapsed_s))
        is_known = math.isfinite(self._heading_offset_deg)
        offset = (self._heading_offset_deg, sd_deg) if is_known else _UNKNOWN_HEADING_OFFSET
        chi2 = self._compute_chi2([*earlier, match], np.column_stack([delays_s, DELAYS_S]), offset)
        chi2 = chi2 - self._compute_chi2(earlier, delays_s[:1], offset)  # of this match alone
        change_s, own = np.abs(DELAYS_S - usual_s), _estimate_delay(chi2) if chi2.min() < _AGREEMENT_CHI2 else None
        near, far = chi2[change_s <= _MAX_DELAY_CHANGE_S].min(), chi2[change_s > _MIN_OTHER_DELAY_S].min()
        if near > _CONTRADICTION_CHI2:
            return (Comparison.OTHER_DELAY if chi2.min() < near - _MIN_GAIN_CHI2 else Comparison.OUTLIER), own
        return (Comparison.AGREES if near < min(_AGREEMENT_CHI2, far - _MIN_LEAD_CHI2) else Comparison.UNKNOWN), own

    def _compute_chi2(
        self, matches: list[TimedMatch], delays_s: Doubles, offset: tuple[float, float] = _UNKNOWN_HEADING_OFFSET
    ) -> Doubles:
        """Return the chi-square (k,) of matches against the reported motion, with k sets of delays (k, n). `offset`:
        mean heading of the matches minus that reported, and its standard deviation, degrees."""
        motion_s, east_m, north_m, headings_deg, _, _, growth_m2_s2, start_m2_s2 = np.array(self._motion).T
        rows = [(match.t_s, match.east_m, match.north_m, match.heading_deg, match.sd_m) for match in matches]
        t_s, *matched_m, matched_deg, sd_m = np.array(rows).T
        exposure_s = t_s - delays_s
        elapsed_s = exposure_s - exposure_s.min()
        earlier_s = np.minimum(elapsed_s[:, :, None], elapsed_s[:, None, :])
        drift_m2 = _integrate_drift(motion_s - exposure_s.min(), growth_m2_s2, elapsed_s, earlier_s)
        drift_m2 += np.interp(exposure_s.min(), motion_s, start_m2_s2) * elapsed_s[:, :, None] * elapsed_s[:, None, :]
        inverse = np.linalg.inv(_START_SD_M**2 + drift_m2 + np.diag(sd_m**2))
        chi2 = np.zeros(len(delays_s))
        for axis_m, path_m in zip(matched_m, (east_m, north_m), strict=True):
            residual_m = axis_m - np.interp(exposure_s, motion_s, path_m)
            chi2 += np.einsum("ki,kij,kj->k", residual_m, inverse, residual_m)
        residual_deg = np.asarray(wrap_deg(matched_deg - np.interp(exposure_s, motion_s, headings_deg) - offset[0]))
        is_known = np.isfinite(residual_deg).all(axis=0)
        residual_deg, earlier_s = residual_deg[:, is_known], earlier_s[:, is_known][:, :, is_known]
        drift_deg2 = offset[1] ** 2 + _HEADING_RANDOM_WALK_DEG**2 * earlier_s
        inverse = np.linalg.inv(drift_deg2 + _DIRECTION_SD_DEG**2 * np.eye(residual_deg.shape[1]))
        chi2 += np.einsum("ki,kij,kj->k", residual_deg, inverse, residual_deg)
        return chi2


def _estimate_delay(chi2: Doubles) -> Delay:
    """Return the delay, given the chi-square (k,) of each of DELAYS_S."""
    weights = np.exp((chi2.min() - chi2) / 2)
    weights /= weights.sum()
    mean_s = float(weights @ DELAYS_S)
    return Delay(mean_s, math.sqrt(float(weights @ (DELAYS_S - mean_s) ** 2)))


def _integrate_drift(motion_s: Doubles, growth_m2_s2: Doubles, elapsed_s: Doubles, earlier_s: Doubles) -> Doubles:
    """Return the covariance (k, n, n), m2, of a velocity error integrated from 0 to the times `elapsed_s` (k, n). Its
    variance grows by `growth_m2_s2` (m,) at the times `motion_s` (m,). `earlier_s` (k, n, n): the earlier of each
    pair of times."""
    growth_m2_s2 = np.where(motion_s > 0, growth_m2_s2, 0.0)
    sums = np.cumsum(growth_m2_s2), np.cumsum(growth_m2_s2 * motion_s), np.cumsum(growth_m2_s2 * motion_s**2)
    zeroth, first, second = (np.interp(earlier_s, motion_s, total) for total in sums)
    one_s, other_s = elapsed_s[:, :, None], elapsed_s[:, None, :]
    return np.asarray(zeroth * one_s * other_s - first * (one_s + other_s) + second)
