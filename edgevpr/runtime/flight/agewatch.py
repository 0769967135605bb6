"""The hidden delay of pictures: by how much they are older than time stamps and arrival say, as an encoder or a buffer
before the stamp makes them. Only the aircraft's own motion shows it.

Accepted matches are compared with the motion that the autopilot reports. In turns and where the speed changes, a delay
moves and turns each match as no wind and no wrong compass does. A delay that is known is taken out of the time of each
picture. If pictures are suddenly of another age than those before, their age is unknown, and none is used, until they
are as before or have shown their new delay. In straight flight at a constant speed, matches show no delay that has been
there from the start: then positions claim what is usual for the kind of camera (`Frame.delay_sd_s`).
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import offset_m, wrap_deg
from edgevpr.core.types import FRAME_TIME_SD_S, Frame, Position
from edgevpr.runtime.recognise.recognition import Recognition

DELAYS_S = np.arange(-1.0, 6.05, 0.1)  # those that are tried

_HISTORY_S = 60.0  # of the motion; matches of that time are compared with it
_MAX_MOTION_GAP_S = 1.0  # between two reports
_MIN_INTERVAL_S = 0.9  # matches nearer to each other say the same
_MAX_MATCHES = 20
_MIN_MATCHES = 4  # that say anything of a delay
# What the usual delay counts against another one, as chi-square: at most this, since a delay of seconds is possible;
# pictures that are newer than they claim are so many times less usual than older ones, without this limit.
_MAX_PRIOR_CHI2 = 30.0
_NEGATIVE_FACTOR = 4.0
# By how much reported motion and matches may differ, beside the accuracy that a match says of itself: velocity by an
# unknown wind (m/s), which changes (m/s in one second), or with GPS; direction by compass and mounting, which wanders.
_START_SD_M = 1e3
_WIND_SD_M_S = 8.0
_GUST_SD_M_S = 0.5
_GPS_SD_M_S = 0.2
_GPS_WANDER_M_S = 0.05
_MATCH_SD_M = 1.5
_COMPASS_WANDER_DEG = 0.3
_DIRECTION_SD_DEG = 2.0
_COMPASS_GAIN = 0.25
_UNKNOWN_COMPASS = 0.0, 30.0
# A match contradicts the delay so far if that explains it badly, and another one far better; it agrees with it if that
# explains it, and another one does not: chi-square with three degrees of freedom. From one opening of a stream to the
# next a delay may change by so much; one that differs by 1.5 s is another one.
_CONTRADICTION_CHI2 = 14.0
_MIN_GAIN_CHI2 = 10.0
_AGREEMENT_CHI2 = 9.0
_MIN_LEAD_CHI2 = 6.0
_MAX_DELAY_CHANGE_S = 0.5
_MIN_OTHER_DELAY_S = 1.5
_MAX_COMPARED = 12  # matches
_MAX_DELAY_SD_S = 0.3  # standard deviation of a delay that is known
_MAX_COST = 3.0  # chi-square of each match, of those that have one delay
_MIN_OTHER_MATCHES = 8  # matches that may show a delay that is another one
_MEMORY_SHARE = 0.9  # share of what was learnt half a minute ago that still counts
_MIN_AGREEING = 2  # matches in a row after which pictures count as before
_MAX_OUTLIERS = 3  # contradictions in a row that no delay explains: then the reported motion is wrong


@dataclass(frozen=True, slots=True, kw_only=True)
class Sighting:
    """An accepted match of a picture that claims to be taken at `t_s`: where it puts the aircraft, metres east and
    north, with their standard deviation `sd_m`, and its heading (NaN: unknown). `delay_s`: its own delay, where it
    differs from that of the others (None: it does not)."""

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
    """What a match says of the delay of those before it; UNKNOWN: little. OUTLIER: no delay explains it."""

    AGREES = auto()
    UNKNOWN = auto()
    OTHER_DELAY = auto()
    OUTLIER = auto()


class AgeWatch:
    """Finds the hidden delay of the pictures of one camera. `is_unknown`: their age is unknown at present."""

    def __init__(self) -> None:
        self.is_unknown = False
        # Reports: time, metres east and north, heading, velocity, variance its error has grown by, and that at a start.
        self._motion: deque[tuple[float, ...]] = deque()
        self._origin: Position | None = None
        self._sightings: list[Sighting] = []
        self._others: list[Sighting] = []  # those since the age became unknown
        self._delay: Delay | None = None
        self._learnt, self._learnt_s = np.zeros(len(DELAYS_S)), -math.inf  # against each delay, by matches until then
        self._compass_deg, self._compass_s = math.nan, 0.0  # headings seen less those reported, until then
        self._usual_s, self._taken_out_s = FRAME_TIME_SD_S, 0.0
        self._agreeing = self._outliers = 0

    @property
    def delay_s(self) -> float:
        """The delay that is taken out, seconds; 0 where none is known."""
        return self._delay.s if self._delay and abs(self._delay.s) > 2 * self._delay.sd_s else 0.0

    def add_motion(self, t_s: float, velocity_m_s: Doubles, heading_deg: float | None, has_gps: bool) -> None:
        """Add the reported motion at `t_s`: velocity (2,), east and north, as good as a GPS receiver measures it or
        not, and heading of the aircraft."""
        if self._motion and t_s <= self._motion[-1][0]:
            return
        if self._motion and t_s - self._motion[-1][0] > _MAX_MOTION_GAP_S:
            self._motion.clear()
            self._sightings, self._others = [], []
        heading_deg = math.nan if heading_deg is None else heading_deg
        east_m_s, north_m_s = map(float, velocity_m_s)
        east_m, north_m, grown = 0.0, 0.0, 0.0
        start = (_GPS_SD_M_S if has_gps else _WIND_SD_M_S) ** 2
        if self._motion:
            before_s, east_m, north_m, before_deg, was_east_m_s, was_north_m_s, _, before = self._motion[-1]
            step_s = t_s - before_s
            east_m += step_s / 2 * (was_east_m_s + east_m_s)
            north_m += step_s / 2 * (was_north_m_s + north_m_s)
            grown = step_s * (_GPS_WANDER_M_S if has_gps else _GUST_SD_M_S) ** 2 + abs(start - before)
            if math.isfinite(before_deg):
                heading_deg = before_deg + float(wrap_deg(heading_deg - before_deg))  # without a step at north
        self._motion.append((t_s, east_m, north_m, heading_deg, east_m_s, north_m_s, grown, start))
        while t_s - self._motion[0][0] > _HISTORY_S + DELAYS_S[-1]:
            self._motion.popleft()

    def correct(self, frame: Frame) -> Frame:
        """Return a frame with the delay taken out of its time, and the error of the delay in that of its time."""
        self._usual_s, self._taken_out_s = frame.delay_sd_s, self.delay_s
        known = self._delay or Delay(0.0, frame.delay_sd_s)
        sd_s = math.hypot(known.sd_s, known.s - self._taken_out_s)
        return replace(frame, t_mono_s=frame.t_mono_s - self._taken_out_s, t_sd_s=math.hypot(frame.t_sd_s, sd_s))

    def judge(self, event: Recognition) -> None:
        """Learn from the accepted match of the frame that `correct` returned last; it is not to be used if the age is
        unknown then."""
        self._drop_old()
        seen = self._observe(event)
        if seen is None:
            return
        found, own = self._compare(seen)
        self._agreeing = self._agreeing + 1 if found is Comparison.AGREES else 0
        self._outliers = self._outliers + 1 if found is Comparison.OUTLIER else 0
        self.is_unknown |= found is Comparison.OTHER_DELAY
        if self.is_unknown:
            self._others.append(seen)
            if own and own.sd_s < _MAX_DELAY_CHANGE_S and found is not Comparison.OUTLIER:
                self._sightings = [*self._sightings[1 - _MAX_MATCHES :], replace(seen, delay_s=own.s)]
            self._resume()
        elif self._outliers == _MAX_OUTLIERS:
            self._sightings, self._outliers = [seen], 0
        elif not self._outliers and (not self._sightings or seen.t_s - self._sightings[-1].t_s >= _MIN_INTERVAL_S):
            self._sightings = [*self._sightings[1 - _MAX_MATCHES :], seen]
            self._learn(seen.t_s)
            self._compare_compass(seen)

    def _learn(self, now_s: float) -> None:
        """Estimate the delay anew with one match more."""
        new = [sighting for sighting in self._sightings if sighting.t_s > self._learnt_s and sighting.delay_s is None]
        if len(new) < _MIN_MATCHES:
            return
        shown = self._learnt + self._cost(new, np.tile(DELAYS_S[:, None], len(new)))
        if shown.min() > _MAX_COST * len(new):
            return
        over = DELAYS_S / self._usual_s
        prior = np.where(over < 0, (_NEGATIVE_FACTOR * over) ** 2, np.minimum(over**2, _MAX_PRIOR_CHI2))
        self._delay = _estimate_delay(shown + prior)
        if now_s - new[0].t_s > _HISTORY_S / 2 or len(new) == _MAX_MATCHES:
            self._learnt_s, self._learnt = now_s, _MEMORY_SHARE * (shown - shown.min())

    def _compare_compass(self, seen: Sighting) -> None:
        """Learn by how much the headings of pictures and compass differ, while the delay is as usual."""
        times_s, _, _, headings_deg, *_ = np.array(self._motion).T
        taken_s = seen.t_s - (self._delay.s if self._delay else 0.0)
        off_deg = float(wrap_deg(seen.heading_deg - np.interp(taken_s, times_s, headings_deg)))
        if math.isfinite(off_deg):
            before_deg = self._compass_deg if math.isfinite(self._compass_deg) else off_deg
            self._compass_deg = before_deg + _COMPASS_GAIN * float(wrap_deg(off_deg - before_deg))
            self._compass_s = seen.t_s

    def _resume(self) -> None:
        """Use pictures again if they are as old as before, or have shown by themselves how old they are now."""
        if self._agreeing >= _MIN_AGREEING:
            self._others, self.is_unknown = [], False
        if len(self._others) < _MIN_OTHER_MATCHES:
            return
        shown = self._cost(self._others, np.tile(DELAYS_S[:, None], len(self._others)))
        found = _estimate_delay(shown)
        if (
            shown.min() < _MAX_COST * len(self._others)
            and found.sd_s < _MAX_DELAY_SD_S
            and found.s > -_MAX_DELAY_CHANGE_S
        ):
            self._sightings, self._others, self._delay, self.is_unknown = self._others, [], found, False
            self._learnt_s, self._learnt = -math.inf, np.zeros(len(DELAYS_S))

    def _drop_old(self) -> None:
        """Forget matches from before the motion that is kept."""
        from_s = self._motion[0][0] + DELAYS_S[-1] if self._motion else math.inf
        self._sightings = [sighting for sighting in self._sightings if sighting.t_s >= from_s]
        self._others = [sighting for sighting in self._others if sighting.t_s >= from_s][-_MAX_MATCHES:]

    def _observe(self, event: Recognition) -> Sighting | None:
        """Return what a match says of the aircraft; None if the motion at that time is not known."""
        where, frame = event.located, event.frame
        if where is None or frame is None or not self._motion:
            return None
        t_s, here = frame.t_mono_s + self._taken_out_s, where.position
        if not self._motion[0][0] <= t_s - DELAYS_S[-1] <= t_s <= self._motion[-1][0] + _MAX_MOTION_GAP_S:
            return None
        self._origin = self._origin or here
        east_m, north_m = offset_m(self._origin.lat_deg, self._origin.lon_deg, here.lat_deg, here.lon_deg)
        heading_deg = math.nan
        if where.heading_deg is not None and event.view.up_deg is not None:
            times_s, _, _, headings_deg, *_ = np.array(self._motion).T
            turn_deg = wrap_deg(where.heading_deg - event.view.up_deg)
            heading_deg = float(np.interp(frame.t_mono_s, times_s, headings_deg) + turn_deg)
        sd_m = math.hypot(where.sd_m, _MATCH_SD_M)
        return Sighting(t_s=t_s, east_m=float(east_m), north_m=float(north_m), heading_deg=heading_deg, sd_m=sd_m)

    def _compare(self, seen: Sighting) -> tuple[Comparison, Delay | None]:
        """Compare a match with the delay of those before it; return also its own delay (None: none fits)."""
        before = self._sightings[-_MAX_COMPARED:]
        if self._delay is None or len(before) < _MIN_MATCHES:
            return Comparison.UNKNOWN, None
        usual_s = self._delay.s
        row_s = [usual_s if sighting.delay_s is None else sighting.delay_s for sighting in before]
        delays_s = np.tile(row_s, (len(DELAYS_S), 1))
        since_s = max(0.0, before[0].t_s - self._compass_s)
        known = self._compass_deg, math.hypot(_DIRECTION_SD_DEG, _COMPASS_WANDER_DEG * math.sqrt(since_s))
        compass = known if math.isfinite(self._compass_deg) else _UNKNOWN_COMPASS
        more = self._cost([*before, seen], np.column_stack([delays_s, DELAYS_S]), compass)
        more = more - self._cost(before, delays_s[:1], compass)
        apart_s, own = np.abs(DELAYS_S - usual_s), _estimate_delay(more) if more.min() < _AGREEMENT_CHI2 else None
        near, far = more[apart_s <= _MAX_DELAY_CHANGE_S].min(), more[apart_s > _MIN_OTHER_DELAY_S].min()
        if near > _CONTRADICTION_CHI2:
            return (Comparison.OTHER_DELAY if more.min() < near - _MIN_GAIN_CHI2 else Comparison.OUTLIER), own
        return (Comparison.AGREES if near < min(_AGREEMENT_CHI2, far - _MIN_LEAD_CHI2) else Comparison.UNKNOWN), own

    def _cost(
        self, sightings: list[Sighting], delays_s: Doubles, compass: tuple[float, float] = _UNKNOWN_COMPASS
    ) -> Doubles:
        """Return how badly matches fit the reported motion with delays (k, n), in each of k cases: chi-square (k,).
        `compass`: by how much headings seen exceed those reported, and the standard deviation, degrees."""
        moved_s, east_m, north_m, turned_deg, _, _, grown, start = np.array(self._motion).T
        rows = [(seen.t_s, seen.east_m, seen.north_m, seen.heading_deg, seen.sd_m) for seen in sightings]
        t_s, *seen_m, seen_deg, sd_m = np.array(rows).T
        taken_s = t_s - delays_s
        since_s = taken_s - taken_s.min()
        first_s = np.minimum(since_s[:, :, None], since_s[:, None, :])
        drift_m2 = _sum_drift(moved_s - taken_s.min(), grown, since_s, first_s)
        drift_m2 += float(np.interp(taken_s.min(), moved_s, start)) * since_s[:, :, None] * since_s[:, None, :]
        inverse = np.linalg.inv(_START_SD_M**2 + drift_m2 + np.diag(sd_m**2))
        cost = np.zeros(len(delays_s))
        for seen, moved in zip(seen_m, (east_m, north_m), strict=True):
            off_m = seen - np.interp(taken_s, moved_s, moved)
            cost += np.einsum("ki,kij,kj->k", off_m, inverse, off_m)
        off_deg = np.asarray(wrap_deg(seen_deg - np.interp(taken_s, moved_s, turned_deg) - compass[0]))
        is_known = np.isfinite(off_deg).all(axis=0)
        off_deg, first_s = off_deg[:, is_known], first_s[:, is_known][:, :, is_known]
        wander_deg2 = compass[1] ** 2 + _COMPASS_WANDER_DEG**2 * first_s
        inverse = np.linalg.inv(wander_deg2 + _DIRECTION_SD_DEG**2 * np.eye(off_deg.shape[1]))
        cost += np.einsum("ki,kij,kj->k", off_deg, inverse, off_deg)
        return cost


def _estimate_delay(against: Doubles) -> Delay:
    """Return the delay, if so much (chi-square) speaks against each of DELAYS_S."""
    weights = np.exp((against.min() - against) / 2)
    weights /= weights.sum()
    mean_s = float(weights @ DELAYS_S)
    return Delay(mean_s, math.sqrt(float(weights @ (DELAYS_S - mean_s) ** 2)))


def _sum_drift(moved_s: Doubles, grown: Doubles, since_s: Doubles, first_s: Doubles) -> Doubles:
    """Return the covariance (k, n, n), m2, of what the error of a velocity adds up to by the times `since_s` (k, n),
    from 0 on, if its variance, m2/s2, grows by `grown` (m,) at the times `moved_s` (m,). `first_s` (k, n, n) is the
    earlier one of each two times."""
    grown = np.where(moved_s > 0, grown, 0.0)
    sums = np.cumsum(grown), np.cumsum(grown * moved_s), np.cumsum(grown * moved_s**2)
    zeroth, first, second = (np.interp(first_s, moved_s, total) for total in sums)
    one_s, other_s = since_s[:, :, None], since_s[:, None, :]
    drift_m2: Doubles = zeroth * one_s * other_s - first * (one_s + other_s) + second
    return drift_m2
