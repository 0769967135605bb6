"""Visual odometry: the motion of the aircraft between two frames, from the landmarks of both pictures.

Both pictures are levelled, so a rotation, a scaling and a shift map the landmarks of one to those of the other, and the
point below the camera is known in each. No map is needed. It works only for cameras that look straight down.
"""

import math
from dataclasses import dataclass
from typing import Any

from edgevpr.core.geodesy import picture_axes, wrap_deg
from edgevpr.frames.level import View
from edgevpr.runtime.recognise.agreement import measure_agreement
from edgevpr.runtime.recognise.landmarks import PLACE_LANDMARKS, Landmarks
from edgevpr.runtime.recognise.parallax import ParallaxChain

# Over repetitive ground such as furrows, landmarks match at many shifts, and few of the matches agree on one.
_MIN_INLIERS = 30
_MIN_INLIER_RATIO = 0.4
_MAX_TURN_DEG = 8.0  # largest rotation, and scaling, between two levelled pictures
_MAX_SCALE = 1.5
_MAX_ELAPSED_S = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryStep:
    """Motion from the frame at `from_s` to that at `to_s`: `moved_m` (east, north), correct if the reported heading and
    height are. `sd_m` is the standard deviation of each axis from the landmarks alone, of which `inliers` agree.
    `log_height`: natural logarithm of the ratio of the height above ground at this step to that at the step before,
    beyond what the reported heights explain, with the standard deviation `log_height_sd`: 0 over flat ground, positive
    over ground that falls away."""

    from_s: float
    to_s: float
    moved_m: tuple[float, float]
    sd_m: float
    inliers: int
    log_height: float = 0.0
    log_height_sd: float = 0.0

    def fields(self) -> dict[str, Any]:
        """Return this step as fields of the flight log."""
        moved_m = [round(axis_m, 2) for axis_m in self.moved_m]
        figures = {"sd_m": round(self.sd_m, 3), "inliers": self.inliers}
        heights = {"log_height": round(self.log_height, 4), "log_height_sd": round(self.log_height_sd, 4)}
        return {"from_s": self.from_s, "moved_m": moved_m, **figures, **heights}


class VisualOdometry:
    """Measures the motion from each frame to the next."""

    def __init__(self) -> None:
        self._previous: tuple[float, View, Landmarks] | None = None
        self._chain = ParallaxChain()

    def measure(self, t_s: float, view: View, landmarks: Landmarks) -> OdometryStep | None:
        """Return the motion from the previous frame to this one, taken at `t_s`; None if it cannot be measured."""
        last, self._previous = self._previous, (t_s, view, landmarks.select_best(PLACE_LANDMARKS))
        chain, self._chain = self._chain, ParallaxChain()  # it breaks unless this step can be measured
        if last is None or not 0 < t_s - last[0] <= _MAX_ELAPSED_S:
            return None
        from_s, start, previous = last
        if start.nadir_offset is None or view.nadir_offset is None or start.up_deg is None or view.up_deg is None:
            return None
        if start.footprint_m is None or view.footprint_m is None:
            return None
        agreement = measure_agreement(landmarks, previous)
        if agreement.inliers < max(_MIN_INLIERS, _MIN_INLIER_RATIO * agreement.matched):
            return None
        matched = agreement.matched_points
        if agreement.shift_share is None or agreement.rotation_deg is None or agreement.scale is None or not matched:
            return None
        rotation_deg = wrap_deg(agreement.rotation_deg - (view.up_deg - start.up_deg))
        start_m, footprint_m = start.footprint_m / start.height_scale, view.footprint_m / view.height_scale
        scale = agreement.scale * start_m / footprint_m
        if abs(rotation_deg) > _MAX_TURN_DEG or not 1 / _MAX_SCALE < scale < _MAX_SCALE:
            return None
        # The point below the camera in the previous picture is that of this picture, rotated, scaled and shifted.
        factor = agreement.scale * complex(math.cos(turn := math.radians(agreement.rotation_deg)), math.sin(turn))
        nadir, start_nadir = (complex(offset[0], -offset[1]) for offset in (view.nadir_offset, start.nadir_offset))
        step = factor * nadir + complex(*agreement.shift_share) - start_nadir
        height = chain.add_step(matched, (nadir, start_nadir), factor, step, footprint_m / start_m)
        self._chain = chain
        east_m, north_m = start_m * picture_axes(start.up_deg) @ (step.real, -step.imag)
        return OdometryStep(
            from_s=from_s,
            to_s=t_s,
            moved_m=(float(east_m), float(north_m)),
            sd_m=start_m * math.sqrt((agreement.covariance_share2 or (0.0,))[0]),
            inliers=agreement.inliers,
            log_height=height.log_ratio,
            log_height_sd=height.sd,
        )
