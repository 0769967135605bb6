"""Strides: the motion of the aircraft between two frames, by the landmarks of both pictures (visual odometry).

Both pictures are levelled, so that the landmarks of one lie on those of the other by a rotation, a scaling and a shift,
and the point under the camera is known in each. No map is needed. It is for cameras that look straight down only.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

from edgevpr.core.geodesy import picture_axes, wrap_deg
from edgevpr.frames.level import View
from edgevpr.runtime.recognise.agreement import measure_agreement
from edgevpr.runtime.recognise.landmarks import PLACE_LANDMARKS, Landmarks

# Over ground that repeats, as furrows do, landmarks match at many shifts: few of the matches agree on one.
_MIN_INLIERS = 30
_MIN_INLIER_SHARE = 0.4
_MAX_TURN_DEG = 8.0  # two levelled pictures lie on each other turned and scaled by no more
_MAX_SCALE = 1.15
_MAX_ELAPSED_S = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryStep:
    """Motion from the frame of `from_s` to that of `to_s`: by `moved_m` (east, north), as far as height and heading are
    right that the pictures were levelled by. `sd_m` is the standard deviation of each axis, by the landmarks alone, of
    which `inliers` agree. `zoom` is the natural logarithm of how much more of the ground a picture shows than the one
    before, beside what their heights explain: over flat ground 0, over ground that falls away above 0."""

    from_s: float
    to_s: float
    moved_m: tuple[float, float]
    sd_m: float
    inliers: int
    zoom: float = 0.0

    def scale(self, factor: float) -> "OdometryStep":
        """Return the motion that the same pictures show from a height that is `factor` times as large."""
        east_m, north_m = self.moved_m
        return replace(self, moved_m=(factor * east_m, factor * north_m), sd_m=factor * self.sd_m)

    def fields(self) -> dict[str, Any]:
        """Return this step as fields of the flight log."""
        moved_m = [round(each, 2) for each in self.moved_m]
        rest = {"sd_m": round(self.sd_m, 3), "inliers": self.inliers, "zoom": round(self.zoom, 4)}
        return {"from_s": self.from_s, "moved_m": moved_m, **rest}


class VisualOdometry:
    """Measures the motion to each frame from the one before."""

    def __init__(self) -> None:
        self._previous: tuple[float, View, Landmarks] | None = None

    def measure(self, t_s: float, view: View, landmarks: Landmarks) -> OdometryStep | None:
        """Return the motion to a frame taken at `t_s`; None if it is unknown. The next one starts there."""
        stored, self._previous = self._previous, (t_s, view, landmarks.best(PLACE_LANDMARKS))
        if stored is None or not 0 < t_s - stored[0] <= _MAX_ELAPSED_S:
            return None
        from_s, start, previous = stored
        if start.nadir_offset is None or view.nadir_offset is None or start.up_deg is None or view.up_deg is None:
            return None
        if start.footprint_m is None or view.footprint_m is None:
            return None
        agreement = measure_agreement(landmarks, previous)
        if agreement.inliers < max(_MIN_INLIERS, _MIN_INLIER_SHARE * agreement.matched):
            return None
        if agreement.shift_share is None or agreement.rotation_deg is None or agreement.scale is None:
            return None
        turned_deg = wrap_deg(agreement.rotation_deg - (view.up_deg - start.up_deg))
        stretched = agreement.scale * start.footprint_m / view.footprint_m
        if abs(turned_deg) > _MAX_TURN_DEG or not 1 / _MAX_SCALE < stretched < _MAX_SCALE:
            return None
        # The point under the camera, in the picture before: that of this picture, turned, scaled and shifted.
        factor = agreement.scale * complex(math.cos(turn := math.radians(agreement.rotation_deg)), math.sin(turn))
        step = factor * complex(view.nadir_offset[0], -view.nadir_offset[1]) + complex(*agreement.shift_share)
        step -= complex(start.nadir_offset[0], -start.nadir_offset[1])
        east_m, north_m = start.footprint_m * picture_axes(start.up_deg) @ (step.real, -step.imag)
        return OdometryStep(
            from_s=from_s,
            to_s=t_s,
            moved_m=(float(east_m), float(north_m)),
            sd_m=start.footprint_m * math.sqrt((agreement.covariance_share2 or (0.0,))[0]),
            inliers=agreement.inliers,
            zoom=math.log(stretched),
        )
