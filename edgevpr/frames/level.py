"""Levelling: warps the image of a downward camera as if it were taken from straight above, north-up and to scale. The
ground is assumed flat. "Level" means without roll and pitch. The footprint of an image is the ground that it shows.
Recognition and mapping level their images through `runtime.recognise.levelling`, which calls this module."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from edgevpr.core.arrays import Doubles, Image, Mask
from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Frame, Vehicle
from edgevpr.frames.homography import Homography, clip_polygon
from edgevpr.frames.lens import CalibratedLens, Remap, compute_lens_view

MAX_TILT_DEG = 63.0  # for a camera mounted 60 degrees forward that sways
# If its lens is unknown, an image is not levelled, and beyond this tilt differs too much from one taken straight down.
# If it is known, the nadir of such an image is near its edge or outside it, and the middle is used instead.
MAX_TILT_UNLEVELLED_DEG = 20.0
# Rays, (right, down, 1) in focal lengths, with a smaller down component are ignored: they show distant ground or sky.
_MIN_RAY_DOWN = 0.1
# Standard deviations of a reported tilt, and of one known only from the camera's mount; both as tangents.
REPORTED_TILT_SD = math.tan(math.radians(1.0))
_MOUNT_TILT_SD = math.tan(math.radians(3.0))
# Smaller corrections do not affect matches.
_MIN_TILT_DEG = 1.0
_MIN_TURN_DEG = 1.0
_MIN_ZOOM_CHANGE = 0.03
# Ratio of an image's footprint to the requested one. Beyond these limits too few of its pixels are used, or too little
# of the output is filled, and a wrong height is a likelier cause than a real difference from the map's height.
_ZOOM_LIMITS = (0.3, 4.0)
_MIN_FILLED_FRACTION = 1 / 3  # of the output area that an image taken straight down would fill
_MAX_HEIGHT_M = 10_000.0
_MAX_SIDE_PX = 1024  # longest side of a warped image: no technique uses more pixels


@dataclass(frozen=True, slots=True)
class Mount:
    """Fixed angles of the camera from straight down, forward and to the right, relative to the airframe or gimbal
    (negative: backward, to the left)."""

    ahead_deg: float = 0.0
    right_deg: float = 0.0

    def body_from_straight(self) -> Doubles:
        """Return the rotation (3, 3), in airframe axes, from straight down to the viewing direction of the camera."""
        # The camera looks forward if the airframe's nose is up, and to the right if its left wing is down.
        return _rotate_body_to_level(-self.right_deg, self.ahead_deg)


STRAIGHT_DOWN = Mount()


@dataclass(frozen=True, slots=True)
class Lens:
    """A camera's lens and mount. `fov_deg`: field of view across the longest side of the image, after undistortion if
    the calibration `calibrated` is given. `up_deg`: direction of the image's top, clockwise from the nose."""

    fov_deg: float
    up_deg: float = 0.0
    calibrated: CalibratedLens | None = None
    mount: Mount = STRAIGHT_DOWN


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """Direction, size and offset of an image on the ground (None: unknown).

    `up_deg`: compass direction (0..360) of the image's top. `footprint_m`: ground length of its longest side.
    `nadir_offset`: from the image's middle to the nadir, the point straight below the camera, (right, up) as
    fractions of the longest side. `nadir_offset_sd`: standard deviation of each component due to errors of a large
    tilt (`recognise.relief` adds that due to the height of the ground). `zoom`: factor by which the image was
    enlarged: its longest side shows that many times less ground. `nadir_offset_m`: the nadir offset on the ground
    (east, north), for an image not warped because its lens is unknown, computed from the height `nadir_height_m`.
    `focal`: focal length as a fraction of the longest side. `rotation_deg`: clockwise rotation that was applied to
    the image. `height_scale`: factor by which the height that `footprint_m` was computed from had been corrected.
    `axis_sd`: `nadir_offset_sd` due to a strip. `reason`: why a tilted image was not warped."""

    up_deg: float | None = None
    footprint_m: float | None = None
    nadir_offset: tuple[float, float] | None = None
    nadir_offset_sd: float = 0.0
    zoom: float = 1.0
    nadir_offset_m: tuple[float, float] | None = None
    nadir_height_m: float | None = None
    focal: float | None = None
    rotation_deg: float = 0.0
    height_scale: float = 1.0
    axis_sd: float = 0.0
    reason: Reason | None = None

    @property
    def is_georeferenced(self) -> bool:
        """True if the image's direction, its size and the nadir offset are known."""
        return None not in (self.up_deg, self.footprint_m, self.nadir_offset)

    @property
    def is_tilt_known(self) -> bool:
        """True if the nadir offset is known, in the image or on the ground."""
        return self.nadir_offset is not None or self.nadir_offset_m is not None

    def fields(self) -> dict[str, Any]:
        """Return this view as fields of the flight log, with rounded numbers. None: unknown."""
        return {
            "up_deg": self.up_deg and round(self.up_deg, 1),
            "footprint_m": self.footprint_m and round(self.footprint_m, 2),
            "nadir_offset": self.nadir_offset and [round(fraction, 4) for fraction in self.nadir_offset],
            "nadir_offset_m": self.nadir_offset_m and [round(offset_m, 2) for offset_m in self.nadir_offset_m],
            "reason": self.reason and self.reason.fields(),
        }


UNKNOWN_VIEW = View()


@dataclass(frozen=True, slots=True)
class LevelledImage:
    """An image ready to be encoded: `image` uint8 (H, W[, 3]); `mask` bool (H, W), False where it shows no ground
    (None: nowhere); and `view`, its direction, size and offset on the ground."""

    image: Image
    mask: Mask | None
    view: View


def level_image(
    frame: Frame,
    vehicle: Vehicle | None,
    lens: Lens,
    footprint_m: float | None = None,
    *,
    overlay: Mask | None = None,
    below: bool = False,
    scale: float = 1.0,
) -> LevelledImage:
    """Warp an image as if it had been taken from straight above. Roll, pitch, heading and height are from the frame or,
    if unknown there, from `vehicle` (None: no report).

    The warp removes roll and pitch (assumed 0 if unknown), rotates the image north-up (unless the heading is unknown)
    and scales it until its longest side shows `footprint_m` (None, or height unknown: by `scale` only). `scale`: ratio
    of the ground that the image really shows to that computed from its height. The middle shows the same point as
    before or, with `below`, the nadir. `overlay`, bool (H, W), is False where the image shows no ground (None:
    nowhere). An image of known pose is returned unchanged. One that needs no warp, or is tilted too far for one, is
    only undistorted. Raises ImageError if the image's aspect ratio differs from that of the lens calibration;
    impossible values in frame or vehicle never raise."""
    if frame.pose is not None:
        view = View(up_deg=frame.pose.up_deg, footprint_m=frame.pose.footprint_m, nadir_offset=(0.0, 0.0))
        return LevelledImage(frame.image, overlay, view)
    camera = _CameraGeometry(frame, vehicle, lens)
    if camera.is_too_tilted:
        view = View(up_deg=camera.top_deg, reason=Reason(ReasonCode.TILTED, {"tilt_deg": camera.tilt_deg}))
        return undistort_frame(frame.image, overlay, view, lens.calibrated)
    if below and camera.tilt_deg > MAX_TILT_UNLEVELLED_DEG and camera.heading_deg is None:
        # The image shows ground far from the aircraft, and only a match can reveal in which direction.
        view = View(reason=Reason(ReasonCode.TILTED_WITHOUT_HEADING, {"tilt_deg": camera.tilt_deg}))
        return undistort_frame(frame.image, overlay, view, lens.calibrated)
    image_m = camera.footprint_m and scale * camera.footprint_m
    zoom = image_m / footprint_m if image_m and footprint_m else scale
    if not _ZOOM_LIMITS[0] <= zoom <= _ZOOM_LIMITS[1]:
        zoom = 1.0
    turn_deg = abs(wrap_deg(camera.top_deg or 0.0))
    if camera.tilt_deg < _MIN_TILT_DEG and turn_deg < _MIN_TURN_DEG and abs(zoom - 1) < _MIN_ZOOM_CHANGE:
        nadir_offset, focal = camera.nadir_offset(camera.straight, 1.0), camera.focal_px / camera.longest_px
        view = View(up_deg=camera.top_deg, footprint_m=image_m, nadir_offset=nadir_offset, focal=focal)
        view = replace(view, nadir_offset_sd=camera.nadir_offset_sd(1.0), height_scale=scale)
        return undistort_frame(frame.image, overlay, view, lens.calibrated)

    below &= camera.tilt_deg <= MAX_TILT_UNLEVELLED_DEG
    side = min(camera.longest_px, _MAX_SIDE_PX)
    out_focal_px = camera.focal_px * zoom * side / camera.longest_px  # focal length of the output, in its pixels
    out_from_lens = camera.straight if camera.heading_deg is None else camera.level_from_lens(-camera.heading_deg)
    middle = np.zeros(2) if below else out_from_lens[:2, 2] / out_from_lens[2, 2] * out_focal_px
    right, down = (side - 1) / 2 - middle
    out_from_ray = np.array([[out_focal_px, 0, right], [0, out_focal_px, down], [0, 0, 1]]) @ out_from_lens
    warp = camera.warp(out_from_ray, out_focal_px, side)

    width, height = (min(1.0, zoom * px / camera.longest_px) for px in camera.size_px)
    if (filled := warp.visible.mean() / (height * width)) < _MIN_FILLED_FRACTION:
        reason = Reason(ReasonCode.TILTED_OFF_GROUND, {"visible_share": float(filled), "tilt_deg": camera.tilt_deg})
        view = View(up_deg=camera.top_deg, reason=reason)
        return undistort_frame(frame.image, overlay, view, lens.calibrated)
    view = View(
        up_deg=None if camera.heading_deg is None else 0.0,
        footprint_m=image_m and image_m / zoom,
        zoom=zoom,
        focal=out_focal_px / side,
        rotation_deg=camera.top_deg or 0.0,
        height_scale=scale,
        nadir_offset=(0.0, 0.0) if below and camera.is_tilt_known else camera.nadir_offset(out_from_lens, zoom),
        nadir_offset_sd=camera.nadir_offset_sd(zoom),
    )
    return _warp_image(frame.image, overlay, warp, view)


def compute_level_rotation(frame: Frame, lens: Lens) -> Doubles:
    """Return the rotation (3, 3) from the axes of the lens to those of a level image with the same top, from the roll
    and pitch of a frame (assumed 0 if unknown) and the mount of the lens."""
    return _CameraGeometry(frame, None, lens).straight


def compute_footprint(frame: Frame, vehicle: Vehicle | None, lens: Lens) -> float | None:
    """Return the ground length in metres that the longest side of an image would have if the image were level, from
    the height in `frame` or, if unknown there, in `vehicle`; None if unknown in both."""
    *_, height_m = _choose_attitude(frame, vehicle)
    if height_m is None or not 0 < height_m <= _MAX_HEIGHT_M:
        return None
    return 2 * height_m * math.tan(math.radians(lens.fov_deg) / 2)


def undistort_frame(image: Image, overlay: Mask | None, view: View, lens: CalibratedLens | None) -> LevelledImage:
    """Remove the distortion of `lens` (None: no distortion) from an image that needs no other warp. `overlay`: as
    in `level_image`. Raises ImageError if the image's aspect ratio differs from that of the calibration."""
    if lens is None:
        return LevelledImage(image, overlay, view)
    height, width = image.shape[:2]
    return _warp_image(image, overlay, compute_lens_view(lens, (width, height)).make_undistortion(_MAX_SIDE_PX), view)


def _warp_image(image: Image, overlay: Mask | None, warp: Homography | Remap, view: View) -> LevelledImage:
    mask = warp.visible if overlay is None else warp.visible & warp.warp_mask(overlay)
    return LevelledImage(warp.warp_image(image), None if mask.all() else mask, view)


def enlarge_image(picture: LevelledImage, zoom: float) -> LevelledImage:
    """Enlarge an image around its middle; its size in pixels stays the same."""
    if zoom == 1:
        return picture
    height_px, width_px = picture.image.shape[:2]
    middle = np.array([width_px - 1, height_px - 1]) / 2
    matrix = np.column_stack([zoom * np.eye(2), (1 - zoom) * middle])
    image = cv2.warpAffine(picture.image, matrix, (width_px, height_px), borderMode=cv2.BORDER_REPLICATE)
    visible = np.ones((height_px, width_px), np.uint8) if picture.mask is None else picture.mask.astype(np.uint8)
    mask = cv2.warpAffine(visible, matrix, (width_px, height_px), flags=cv2.INTER_NEAREST) > 0
    view = replace(picture.view, zoom=zoom * picture.view.zoom)
    return LevelledImage(np.asarray(image, np.uint8), None if mask.all() else mask, view)


def estimate_tilted_view(frame: Frame, vehicle: Vehicle | None, mount: Mount = STRAIGHT_DOWN) -> View:
    """Return the view of an image that cannot be warped because its lens is unknown. Only `nadir_offset_m` is set or,
    for a level image of unknown heading or height, `nadir_offset` with its error or, if the image is tilted too far,
    `reason`; nothing if too little is known. Arguments are as in `level_image`; impossible values never raise."""
    roll_deg, pitch_deg, heading_deg, height_m = _choose_attitude(frame, vehicle)
    if roll_deg is None or pitch_deg is None:
        return UNKNOWN_VIEW
    forward, right, down = (_rotate_body_to_level(roll_deg, pitch_deg) @ mount.body_from_straight())[:, 2]
    tilt_deg = math.degrees(math.acos(max(-1.0, min(1.0, down))))
    if tilt_deg > MAX_TILT_UNLEVELLED_DEG:
        return View(reason=Reason(ReasonCode.TILTED, {"tilt_deg": tilt_deg}))
    if heading_deg is None or height_m is None or not 0 <= height_m <= _MAX_HEIGHT_M:
        # A level image shows the nadir in its middle. The error is that of a lens of 53 degrees, less if it is wider.
        is_level = tilt_deg < _MIN_TILT_DEG
        return View(nadir_offset=(0.0, 0.0), nadir_offset_sd=REPORTED_TILT_SD) if is_level else UNKNOWN_VIEW
    heading = math.radians(heading_deg)
    north = height_m / down * (forward * math.cos(heading) - right * math.sin(heading))
    east = height_m / down * (forward * math.sin(heading) + right * math.cos(heading))
    return View(nadir_offset_m=(-float(east), -float(north)), nadir_height_m=height_m)


class _CameraGeometry:
    """Geometry of an image when it was taken, as far as known; with a calibrated lens, of the undistorted image.

    Rotation matrices are (3, 3). Their axes are those of the lens (right and down in the image, viewing direction),
    of the airframe (forward, right, down), and of the level image (right, down in the image, to the ground).
    `straight`: rotation from lens to level image without a turn about the vertical. `tilt_deg`: angle between the
    viewing direction and straight down; `is_too_tilted`: it is too large for a warp. `top_deg`: compass direction of
    the image's top. `footprint_m`: ground length of the longest side if the image were level. `corners` (3, n):
    corners of the usable part of the image, where rays point down steeply enough, in homogeneous pixels.
    `is_tilt_known`: from a reported attitude or, within a few degrees, from the mount alone."""

    def __init__(self, frame: Frame, vehicle: Vehicle | None, lens: Lens) -> None:
        roll_deg, pitch_deg, self.heading_deg, _ = _choose_attitude(frame, vehicle)
        self._is_attitude_known = roll_deg is not None and pitch_deg is not None
        self.is_tilt_known = self._is_attitude_known or lens.mount != STRAIGHT_DOWN
        attitude_deg = (roll_deg or 0.0, pitch_deg or 0.0) if self._is_attitude_known else (0.0, 0.0)
        self._level_from_straight = _rotate_body_to_level(*attitude_deg) @ lens.mount.body_from_straight()
        self._lens = lens
        height, width = frame.image.shape[:2]
        self._lens_view = compute_lens_view(lens.calibrated, (width, height)) if lens.calibrated else None
        if self._lens_view:
            width, height = self._lens_view.undistorted_px
        self.size_px, self.longest_px = (width, height), max(height, width)
        self.focal_px = self.longest_px / 2 / math.tan(math.radians(lens.fov_deg) / 2)
        self.footprint_m = compute_footprint(frame, vehicle, lens)
        focal, middle = self.focal_px, ((width - 1) / 2, (height - 1) / 2)
        self.lens_from_pixel = np.linalg.inv([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])
        right, bottom = width - 0.5, height - 0.5
        self.corners = np.array([[-0.5, right, right, -0.5], [-0.5, -0.5, bottom, bottom], [1] * 4])
        self.straight = self.level_from_lens(lens.up_deg)
        self.tilt_deg = math.degrees(math.acos(np.clip(self.straight[2, 2], -1, 1)))
        self.is_too_tilted = self.tilt_deg > MAX_TILT_DEG
        if not self.is_too_tilted:
            depth = (self.straight @ self.lens_from_pixel @ self.corners)[2]
            self.corners = clip_polygon(self.corners, depth - _MIN_RAY_DOWN)
        self.top_deg = None if self.heading_deg is None else (self.heading_deg + lens.up_deg) % 360

    def warp(self, out_from_ray: Doubles, out_focal_px: float, side: int) -> Homography | Remap:
        """Return the warp to (side, side) pixels. `out_from_ray`: homography (3, 3) from rays to pixels of the output,
        whose focal length is `out_focal_px` pixels."""
        if self._lens_view:
            return self._lens_view.make_remap(out_from_ray, out_focal_px, (side, side))
        return Homography(out_from_ray @ self.lens_from_pixel, self.corners, side, self.focal_px / out_focal_px)

    def level_from_lens(self, up_deg: float) -> Doubles:
        """Return the rotation from the lens to a level image whose top is `up_deg` clockwise from the nose."""
        return np.asarray(
            _rotate_lens_to_body(up_deg).T @ self._level_from_straight @ _rotate_lens_to_body(self._lens.up_deg)
        )

    def nadir_offset(self, out_from_lens: Doubles, zoom: float) -> tuple[float, float] | None:
        """Return `View.nadir_offset` after rotation by `out_from_lens` and scaling by `zoom`; None: tilt unknown."""
        right, back = out_from_lens[:2, 2] / out_from_lens[2, 2] * zoom * self.focal_px / self.longest_px
        return (float(-right), float(back)) if self.is_tilt_known else None

    def nadir_offset_sd(self, zoom: float) -> float:
        """Return `View.nadir_offset_sd` after scaling by `zoom`. An error of a tilt t moves the nadir by 1 + tan(t)^2
        times the height; for a reported tilt, the 1 is already part of the error of every position."""
        if not self.is_tilt_known:
            return 0.0
        tangent, focal = math.tan(math.radians(self.tilt_deg)), zoom * self.focal_px / self.longest_px
        tilt_gain_sd = REPORTED_TILT_SD * tangent**2 if self._is_attitude_known else _MOUNT_TILT_SD * (1 + tangent**2)
        return float(focal * tilt_gain_sd)


def _choose_attitude(frame: Frame, vehicle: Vehicle | None) -> Iterator[float | None]:
    """Yield roll, pitch, heading (degrees) and height (m), each from the frame, else from the vehicle, else None."""
    for name in ("roll_deg", "pitch_deg", "heading_deg", "height_m"):
        values = (getattr(frame, name), getattr(vehicle, name, None))
        yield next((value for value in values if value is not None and math.isfinite(value)), None)


def _rotate_body_to_level(roll_deg: float, pitch_deg: float) -> Doubles:
    """Return the rotation (3, 3) from the airframe's axes (forward, right, down) to those of a level airframe."""
    roll, pitch = math.radians(roll_deg), math.radians(pitch_deg)
    about_right = [[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]]
    about_nose = [[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]]
    return np.asarray(np.array(about_right) @ np.array(about_nose))


def _rotate_lens_to_body(up_deg: float) -> Doubles:
    """Return the rotation (3, 3) from the axes of a camera that looks straight down to those of the airframe."""
    up = math.radians(up_deg)
    return np.array([[-math.sin(up), -math.cos(up), 0], [math.cos(up), -math.sin(up), 0], [0, 0, 1]])
