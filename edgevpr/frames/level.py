"""Levelling: lays the picture of a camera that looks down on flat ground, north-up and to scale, in one warp."""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.frames.opencv import cv2
from edgevpr.types import Frame, Vehicle

MOST_TILT_DEG = 45.0
_MOST_OFF_DOWN_DEG = 85.0  # of a corner's ray: beyond it are the horizon and ground that fills no pixel
_LEAST_TILT_DEG, _LEAST_TURN_DEG, _LEAST_ZOOM = 1.0, 1.0, 0.03  # less than these changes no match
# Ground length of the picture over the length it is scaled to. Beyond these limits too few of its pixels are left, or
# too little of the output is filled; a height that is so far from the map's is likelier to be wrong.
_ZOOMS = (0.3, 4.0)
_LEAST_FILLED = 1 / 3  # of what the same picture would fill if it were taken straight down
_HIGHEST_M = 10_000.0
_LONGEST_PX = 1024  # of a warped picture: no technique sees more
_SUBPIXEL_BITS = 4


@dataclass(frozen=True, slots=True)
class Lens:
    """A camera without distortion. `fov_deg` is its field of view across the longest side of the picture, and `up_deg`
    the compass direction of the top of the picture while the nose points north."""

    fov_deg: float
    up_deg: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """How a picture lies on the ground (None: unknown). `up_deg` is the compass direction (0..360) of its top, and
    `footprint_m` the length on the ground of its longest side. `aside` is the point straight under the camera, from the
    middle of the picture, (right, up) as shares of the longest side. `reason` tells why the picture was left tilted
    (None: it was not)."""

    up_deg: float | None = None
    footprint_m: float | None = None
    aside: tuple[float, float] | None = None
    reason: str | None = None


UNKNOWN_VIEW = View()


@dataclass(frozen=True, slots=True)
class Levelled:
    """A picture as it is encoded: `image` uint8 (H, W[, 3]), `mask` bool (H, W), False where it does not show ground
    (None: it does everywhere), and how it lies on the ground."""

    image: np.ndarray
    mask: np.ndarray | None
    view: View


def levelled(
    frame: Frame,
    vehicle: Vehicle | None,
    lens: Lens,
    footprint_m: float | None = None,
    *,
    overlay: np.ndarray | None = None,
    below: bool = False,
) -> Levelled:
    """Lay a picture on flat ground, as far as the frame, else the vehicle, tells how it was taken.

    It is untilted by roll and pitch (unknown: it counts as level), turned north-up by the heading (unknown: its top
    stays), and scaled by the height so that its longest side shows `footprint_m` (None, or height unknown: it keeps its
    own scale). In the middle is what the middle of the picture shows, or with `below` the point under the camera.
    `overlay`, bool (H, W), is False where the picture shows no ground. What needs no warp keeps its image, and so does
    what bears none: then `View.reason` says why. No value of frame or vehicle raises.
    """
    if frame.pose is not None:
        known = View(up_deg=frame.pose.up_deg, footprint_m=frame.pose.footprint_m, aside=(0.0, 0.0))
        return Levelled(frame.image, overlay, known)
    roll_deg, pitch_deg, heading_deg, height_m = (
        _known(frame, vehicle, name) for name in ("roll_deg", "pitch_deg", "heading_deg", "height_m")
    )
    is_attitude_known = roll_deg is not None and pitch_deg is not None
    body = _level_from_body(roll_deg, pitch_deg) if is_attitude_known else np.eye(3)
    top_deg = None if heading_deg is None else (heading_deg + lens.up_deg) % 360

    height, width = frame.image.shape[:2]
    longest = max(height, width)
    half = math.tan(math.radians(lens.fov_deg) / 2)
    own_m = 2 * height_m * half if height_m is not None and 0 < height_m <= _HIGHEST_M else None
    zoom = own_m / footprint_m if own_m and footprint_m and _ZOOMS[0] <= own_m / footprint_m <= _ZOOMS[1] else 1.0
    focal_px = longest / 2 / half
    to_lens = np.linalg.inv([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])

    def level_from_lens(up_deg: float) -> np.ndarray:
        return _body_from_lens(up_deg).T @ body @ _body_from_lens(lens.up_deg)

    def aside_of(turned: np.ndarray, focal_share: float) -> tuple[float, float] | None:
        right, down = turned[:2, 2] / turned[2, 2] * focal_share
        return (float(-right), float(down)) if is_attitude_known else None

    straight = level_from_lens(lens.up_deg)
    tilt_deg = math.degrees(math.acos(np.clip(straight[2, 2], -1, 1)))
    corners = np.array([[-0.5, width - 0.5, width - 0.5, -0.5], [-0.5, -0.5, height - 0.5, height - 0.5], [1] * 4])
    rays = straight @ to_lens @ corners
    lowest = float((rays[2] / np.linalg.norm(rays, axis=0)).min())
    if tilt_deg > MOST_TILT_DEG or lowest < math.cos(math.radians(_MOST_OFF_DOWN_DEG)):
        return Levelled(frame.image, overlay, View(up_deg=top_deg, reason=f"it is tilted {tilt_deg:.0f} degrees"))
    turn_deg = 0.0 if top_deg is None else abs((top_deg + 180) % 360 - 180)
    if tilt_deg < _LEAST_TILT_DEG and turn_deg < _LEAST_TURN_DEG and abs(zoom - 1) < _LEAST_ZOOM:
        view = View(up_deg=top_deg, footprint_m=own_m, aside=aside_of(straight, focal_px / longest))
        return Levelled(frame.image, overlay, view)

    turned = straight if heading_deg is None else level_from_lens(-heading_deg)
    side = min(longest, _LONGEST_PX)
    out_px = focal_px * zoom * side / longest
    middle = np.zeros(2) if below else turned[:2, 2] / turned[2, 2] * out_px
    corner = (side - 1) / 2 - middle
    out_from_pixel = np.array([[out_px, 0, corner[0]], [0, out_px, corner[1]], [0, 0, 1]]) @ turned @ to_lens
    shown = _quadrangle(out_from_pixel @ corners, side)
    expected = min(1.0, zoom * width / longest) * min(1.0, zoom * height / longest)
    if (filled := shown.mean()) < _LEAST_FILLED * expected:
        reason = f"it shows {filled / expected:.0%} of the ground under it at a tilt of {tilt_deg:.0f} degrees"
        return Levelled(frame.image, overlay, View(up_deg=top_deg, reason=reason))
    mask = shown.view(bool)
    if overlay is not None:
        flags = cv2.INTER_NEAREST
        mask &= cv2.warpPerspective(overlay.view(np.uint8), out_from_pixel, (side, side), flags=flags).view(bool)
    view = View(
        up_deg=None if heading_deg is None else 0.0,
        footprint_m=own_m and own_m / zoom,
        aside=(0.0, 0.0) if below and is_attitude_known else aside_of(turned, out_px / side),
    )
    return Levelled(_warped(frame.image, out_from_pixel, side, focal_px / out_px), None if mask.all() else mask, view)


def _known(frame: Frame, vehicle: Vehicle | None, name: str) -> float | None:
    values = (getattr(frame, name), getattr(vehicle, name, None))
    return next((value for value in values if value is not None and math.isfinite(value)), None)


def _level_from_body(roll_deg: float, pitch_deg: float) -> np.ndarray:
    """Return the rotation (3, 3) from nose, right, down of the airframe to those of a level one with its heading."""
    roll, pitch = math.radians(roll_deg), math.radians(pitch_deg)
    about_right = [[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]]
    about_nose = [[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]]
    return np.array(about_right) @ np.array(about_nose)


def _body_from_lens(up_deg: float) -> np.ndarray:
    """Return the rotation (3, 3) to nose, right, down from right, back, down of a picture whose top points `up_deg` to
    the right of the nose."""
    up = math.radians(up_deg)
    return np.array([[-math.sin(up), -math.cos(up), 0], [math.cos(up), -math.sin(up), 0], [0, 0, 1]])


def _quadrangle(corners: np.ndarray, side: int) -> np.ndarray:
    """Fill the quadrangle of homogeneous corners (3, 4) in uint8 (side, side) with 1."""
    points = np.round((corners[:2] / corners[2]).T * 2**_SUBPIXEL_BITS).astype(np.int32)
    return cv2.fillConvexPoly(np.zeros((side, side), np.uint8), points, 1, shift=_SUBPIXEL_BITS)


def _warped(image: np.ndarray, out_from_pixel: np.ndarray, side: int, shrink: float) -> np.ndarray:
    """Warp an image to (side, side). Where `shrink` pixels become one, and they are more than two, their mean is taken
    first: a warp alone would leave most of them out."""
    if shrink > 2:
        height, width = image.shape[:2]
        small = max(1, round(width / shrink)), max(1, round(height / shrink))
        across, down = width / small[0], height / small[1]
        image = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
        out_from_pixel = out_from_pixel @ [[across, 0, (across - 1) / 2], [0, down, (down - 1) / 2], [0, 0, 1]]
    # The edge goes on outside, where the mask is False, so that it makes no gradient inside.
    return cv2.warpPerspective(
        image, out_from_pixel, (side, side), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
