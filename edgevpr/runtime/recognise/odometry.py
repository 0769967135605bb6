"""Visual odometry: the motion of the aircraft between two frames, from the landmarks of both pictures.

Both pictures are levelled, so a rotation, a scaling and a shift map the landmarks of one to those of the other, and the
point below the camera is known in each. No map is needed. It works only for cameras that look straight down."""

import math
from dataclasses import dataclass
from typing import Any

from edgevpr.core.geodesy import picture_axes, wrap_deg
from edgevpr.frames.level import View
from edgevpr.runtime.recognise.agreement import measure_agreement
from edgevpr.runtime.recognise.landmarks import Landmarks
from edgevpr.runtime.recognise.parallax import (
    UNLINKED_SHIFT,
    HeightChange,
    ImageMotion,
    ParallaxChain,
    claim_unseen_change,
)

# Over repetitive ground such as furrows, landmarks match at many shifts, and few of the matches agree on one.
_MIN_INLIERS = 30
_MIN_INLIER_RATIO = 0.4
_MAX_TURN_DEG = 8.0  # largest rotation, and scaling, between two levelled pictures
_MAX_SCALE = 1.5
_MAX_ELAPSED_S = 30.0
# A second apart, one step in ten of a plane in steep turns failed (25 m/s, 100 m up); half a second apart, none.
_MIN_INTERVAL_S = 0.5
_MAX_INTERVAL_S = 2.0
_NOISE_SIGMA = 2.0  # smaller changes of height are noise: over flat ground, following it doubled the error
_MIN_KEY_SHIFT = 0.1  # fraction of the longest side
_UNSEEN_SHIFT = 1.0  # fraction over which any change is possible where pictures do not agree, perhaps because of it
_START_LANDMARKS = 500  # of the earlier picture: enough for three pictures to share some


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryStep:
    """Motion from the frame at `from_s` to that at `to_s`: `moved_m` (east, north), correct if the reported heading and
    height are. `sd_m` is the standard deviation of each axis from the landmarks alone, of which `inliers` agree.
    `log_height`: natural logarithm of the height above ground divided by that at the step before, beyond what the
    reported heights explain (positive over ground that falls away), with the standard deviation `log_height_sd`."""

    from_s: float
    to_s: float
    moved_m: tuple[float, float]
    sd_m: float
    inliers: int
    log_height: float = 0.0
    log_height_sd: float = 0.0

    def fields(self) -> dict[str, Any]:
        """Return this step as fields of the flight log."""
        moved = {"moved_m": [round(axis_m, 2) for axis_m in self.moved_m], "sd_m": round(self.sd_m, 3)}
        heights = {"log_height": round(self.log_height, 4), "log_height_sd": round(self.log_height_sd, 4)}
        return {"from_s": self.from_s, **moved, "inliers": self.inliers, **heights}


@dataclass(frozen=True, slots=True)
class _Picture:
    t_s: float
    view: View
    landmarks: Landmarks


class VisualOdometry:
    """Measures the motion from each frame to the next, and how the height above ground changes."""

    def __init__(self) -> None:
        self._previous: _Picture | None = None
        self._key: _Picture | None = None  # depths are compared from key to key: between frames, shifts may be small
        self._since_key = 0j  # moved since then, as a fraction of the picture's longest side: east + 1j * north
        self._chain, self._climb, self._pending = ParallaxChain(), HeightChange(), HeightChange()
        self._measured_s = self._rate = 0.0  # end of the last step, and its length in a second, as such a fraction

    @property
    def interval_s(self) -> float:
        """Time until the next frame is needed: until a tenth of the image has moved on, or soon after a missed step."""
        if self._previous is None or self._measured_s < self._previous.t_s:
            return _MIN_INTERVAL_S
        return max(_MIN_KEY_SHIFT / max(self._rate, _MIN_KEY_SHIFT / _MAX_INTERVAL_S), _MIN_INTERVAL_S)

    def measure(self, t_s: float, view: View, landmarks: Landmarks) -> OdometryStep | None:
        """Return the motion from the previous frame to this one, taken at `t_s`; None if it cannot be measured."""
        last, self._previous = self._previous, _Picture(t_s, view, landmarks)
        motion = _measure_motion(last, self._previous) if last and 0 < t_s - last.t_s <= _MAX_ELAPSED_S else None
        if last is None or motion is None:
            return None
        start, start_m = last.view, (last.view.footprint_m or 0.0) / last.view.height_scale
        east, north = picture_axes(start.up_deg or 0.0) @ (motion.offset.real, -motion.offset.imag)
        self._since_key += complex(east, north)
        missed = self._rate * (last.t_s - self._measured_s)
        self._measured_s, self._rate = t_s, abs(motion.offset) / (t_s - last.t_s)
        climb, self._climb = self._climb, HeightChange()  # up to the start of this step
        height = self._suppress_noise(climb, self._follow_height(last, self._previous, motion, missed))
        return OdometryStep(
            from_s=last.t_s,
            to_s=t_s,
            moved_m=(start_m * float(east), start_m * float(north)),
            sd_m=start_m * motion.offset_sd,
            inliers=motion.inliers,
            log_height=height.log_ratio,
            log_height_sd=height.sd,
        )

    def _suppress_noise(self, *changes: HeightChange) -> HeightChange:
        """Return the change of height to use: measured ones once their sum is more than noise, assumed ones at once."""
        measured_sd = math.hypot(*(change.sd for change in changes if change.is_measured))
        assumed_sd = math.hypot(*(change.sd for change in changes if not change.is_measured))
        log_ratio = self._pending.log_ratio + sum(change.log_ratio for change in changes)
        sum_sd = math.hypot(self._pending.sd, measured_sd)
        if abs(log_ratio) <= _NOISE_SIGMA * sum_sd:
            self._pending = HeightChange(log_ratio, sum_sd)
            return HeightChange(0.0, math.hypot(assumed_sd, measured_sd / 2))
        self._pending = HeightChange()
        return HeightChange(log_ratio, math.hypot(assumed_sd, sum_sd))

    def _follow_height(self, last: _Picture, now: _Picture, motion: ImageMotion, missed: float) -> HeightChange:
        """Return the change of height since the key picture, if that is far enough away, or steps were `missed`."""
        self._key = key = self._key or last
        share = abs(self._since_key)
        if share + missed < _MIN_KEY_SHIFT:
            return HeightChange()
        since_key = motion if key is last else _measure_motion(key, now)
        self._key, self._since_key = now, 0j
        if since_key and abs(since_key.offset) >= _MIN_KEY_SHIFT / 2:
            change, self._climb = self._chain.add(since_key)
            return change
        self._chain = ParallaxChain()
        return claim_unseen_change(missed / _UNSEEN_SHIFT + share / UNLINKED_SHIFT)


def _measure_motion(start: _Picture, now: _Picture) -> ImageMotion | None:
    """Return the motion between two pictures; None if it cannot be measured."""
    one, other = start.view, now.view
    if one.nadir_offset is None or other.nadir_offset is None or one.up_deg is None or other.up_deg is None:
        return None
    if one.footprint_m is None or other.footprint_m is None:
        return None
    agreement = measure_agreement(now.landmarks, start.landmarks.select_best(_START_LANDMARKS))
    if agreement.inliers < max(_MIN_INLIERS, _MIN_INLIER_RATIO * agreement.matched):
        return None
    pairs, rotation_deg, share = agreement.matched_points, agreement.rotation_deg, agreement.shift_share
    if pairs is None or rotation_deg is None or share is None or agreement.scale is None:
        return None
    expected_scale = other.footprint_m / other.height_scale * one.height_scale / one.footprint_m
    turned_deg = wrap_deg(rotation_deg - (other.up_deg - one.up_deg))
    if abs(turned_deg) > _MAX_TURN_DEG or abs(math.log(agreement.scale / expected_scale)) > math.log(_MAX_SCALE):
        return None
    factor = agreement.scale * complex(math.cos(turn := math.radians(rotation_deg)), math.sin(turn))
    nadir, start_nadir = (complex(offset[0], -offset[1]) for offset in (other.nadir_offset, one.nadir_offset))
    # The point below the camera in the start picture is that of this picture, rotated, scaled and shifted.
    offset = factor * nadir + complex(*share) - start_nadir
    offset_sd = math.sqrt((agreement.covariance_share2 or (0.0,))[0])
    return ImageMotion(pairs, (nadir, start_nadir), factor, offset, offset_sd, agreement.inliers, expected_scale)
