"""Levelling: removes lens distortion, and warps the image of a camera that looks straight down as if the aircraft
flew level. A wrong height gives a wrong scale; a technique with `height_ratios` still recognises the image."""

import logging
import math
from dataclasses import dataclass, field, replace

from edgevpr.core.arrays import Mask
from edgevpr.core.config import SourceConfig
from edgevpr.core.contract import Technique
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import move_position, picture_axes
from edgevpr.core.types import Frame, Pose, Vehicle
from edgevpr.frames import level
from edgevpr.frames.lens import CalibratedLens, compute_lens_view, read_lens
from edgevpr.frames.source import is_live
from edgevpr.places.layers import Layers
from edgevpr.runtime.recognise.relief import compute_nadir_sd

GPS_SD_M = 5.0  # standard deviation of a recorded position along one axis, unless a better one is known
# Distance, as a fraction of the footprint, from the image's centre to the point below an aircraft tilted by 3 degrees.
# Chosen on generated flights and aerial_swindale.
TILT_SD_WITHOUT_ATTITUDE = 0.04
_MAX_OFFSET_WITHOUT_HEADING = 0.25  # of the longest side: beyond it, the image shows other ground
_MAX_FOV_DIFFERENCE_DEG = 5.0  # data sheets round the field of view

_log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class Levelling:
    """Levels the images of a camera that looks straight down, see `frames.level`. Without a `lens` they are not
    warped: only the distance on the ground from the point below the camera to the image's centre is computed,
    from the `mount` of the camera. A `lens` has its own mount.

    With `below`, for places, the point below the camera becomes the centre. `is_on_gimbal`: a gimbal keeps the camera
    level, unless the frame itself has other angles. `is_live` is False for recorded frames, for which the autopilot's
    reports do not apply."""

    lens: level.Lens | None = field(kw_only=False)
    below: bool = False
    is_on_gimbal: bool = False
    is_live: bool
    mount: level.Mount = level.STRAIGHT_DOWN
    _has_warned: bool = field(default=False, init=False)

    def replace_mount(self, mount: level.Mount) -> "Levelling":
        """Return the same levelling for a camera with another `mount`."""
        return replace(self, lens=self.lens and replace(self.lens, mount=mount), mount=mount)

    def prepare(
        self,
        frame: Frame,
        vehicle: Vehicle | None,
        overlay: Mask | None,
        *,
        layers: Layers | None = None,
        scale: float = 1.0,
    ) -> level.LevelledImage:
        """Level the image of a frame. `vehicle` is the autopilot's report (None: unknown). `overlay`, bool (H, W), is
        False where the image shows no ground (None: it shows ground everywhere). The image's longest side is scaled to
        the footprint of the places to search, chosen from their `layers` (None: no scaling). It shows `scale` times as
        much ground as expected at its height or, if that is unknown, as the images of the map."""
        if vehicle and not (self.is_live and vehicle.is_fresh(frame.t_mono_s)):
            vehicle = None
        if self.is_on_gimbal and None in (frame.roll_deg, frame.pitch_deg):
            frame = replace(frame, roll_deg=0.0, pitch_deg=0.0)
        if self.lens is None:
            view = level.estimate_tilted_view(frame, vehicle, self.mount)
            return level.enlarge_image(level.LevelledImage(frame.image, overlay, view), scale)
        full_m = level.compute_footprint(frame, vehicle, self.lens) if layers else None
        footprint_m = layers.choose_footprint(full_m and scale * full_m) if layers else None
        picture = level.level_image(
            frame, vehicle, self.lens, footprint_m, overlay=overlay, below=self.below, scale=scale
        )
        if picture.view.reason and not self._has_warned:
            self._has_warned = True
            _log.warning("%s: %s (further frames are not reported)", frame.name, picture.view.reason)
        return picture


@dataclass(frozen=True, slots=True)
class Undistortion:
    """Removes lens distortion from the images of a camera that looks ahead, which are not levelled."""

    lens: CalibratedLens

    def prepare(self, frame: Frame, vehicle: Vehicle | None, overlay: Mask | None, **_: object) -> level.LevelledImage:
        """Undistort the image of a frame, which has no scale. Arguments as in `Levelling.prepare`."""
        return level.undistort_frame(frame.image, overlay, level.UNKNOWN_VIEW, self.lens)


def make_levelling(
    config: SourceConfig, technique: Technique, *, below: bool = False
) -> Levelling | Undistortion | None:
    """Make the image preparation for a configuration; None for a camera of unknown lens that looks ahead. Raises
    ConfigError for an unusable calibration, UsageError for a field of view that contradicts it."""
    if technique.spec.parameters.get("camera") != "nadir":
        calibrated = load_calibrated_lens(config)
        return Undistortion(calibrated) if calibrated else None
    lens = read_camera_lens(config)
    if lens is None:
        _log.info("no correction for tilt, height or heading: set source.fov_deg (--fov-deg)")
    return Levelling(
        lens, below=below, is_on_gimbal=config.gimbal, is_live=is_live(config.uri), mount=read_mount(config)
    )


def read_camera_lens(config: SourceConfig) -> level.Lens | None:
    """Return the lens of the configured camera; None if unknown. Raises the errors of `make_levelling`."""
    calibrated = load_calibrated_lens(config)
    fov_deg = compute_lens_view(calibrated, calibrated.size_px).fov_deg if calibrated else config.fov_deg
    return None if fov_deg is None else level.Lens(fov_deg, config.up_deg, calibrated, read_mount(config))


def read_mount(config: SourceConfig) -> level.Mount:
    """Return the mounting angles of the configured camera, relative to straight down."""
    return level.Mount(config.mount_ahead_deg, config.mount_right_deg)


def load_calibrated_lens(config: SourceConfig) -> CalibratedLens | None:
    """Read the configured lens calibration (None: there is none). Raises the errors of `make_levelling`."""
    if config.lens is None:
        return None
    lens = read_lens(config.lens)
    full_fov_deg = compute_lens_view(lens, lens.size_px).full_fov_deg
    if config.fov_deg is not None and abs(config.fov_deg - full_fov_deg) > _MAX_FOV_DIFFERENCE_DEG:
        raise UsageError(
            f"`source.fov_deg` is {config.fov_deg:g}, but it is {full_fov_deg:.0f} in {config.lens}: remove `fov_deg`, "
            "or use the calibration of this camera."
        )
    return lens


def set_picture_heading(frame: Frame, view: level.View) -> Frame:
    """Return the frame with the heading of the top of its levelled image, if known. The hints use this heading."""
    return frame if view.up_deg is None else replace(frame, heading_deg=view.up_deg)


def centre_place(frame: Frame, view: level.View) -> Frame:
    """Convert a frame to the form stored for a place. Its heading becomes that of the levelled image. Its position,
    if any, becomes that of the image's centre instead of the aircraft, if that can be computed. With a known
    height and heading, a pose is added."""
    frame = set_picture_heading(frame, view)
    if view.nadir_offset and view.up_deg is None and math.hypot(*view.nadir_offset) > _MAX_OFFSET_WITHOUT_HEADING:
        return replace(frame, position=None)
    if frame.position and view.nadir_offset_m:
        east_m, north_m = view.nadir_offset_m
        return replace(frame, position=move_position(frame.position, -east_m, -north_m, frame.position.alt_m))
    if frame.pose is not None or frame.position is None or view.up_deg is None or view.footprint_m is None:
        return frame
    variance_m2, position = GPS_SD_M**2 + (view.axis_sd * view.footprint_m) ** 2, frame.position
    if view.nadir_offset is None:
        variance_m2 += (TILT_SD_WITHOUT_ATTITUDE * view.footprint_m) ** 2
    else:
        # The nadir is below the aircraft; seen from there, the image's centre is in the opposite direction.
        variance_m2 += (compute_nadir_sd(view) * view.footprint_m) ** 2
        east_m, north_m = (-view.footprint_m * picture_axes(view.up_deg) @ view.nadir_offset).tolist()
        position = move_position(position, east_m, north_m, position.alt_m)
    pose = Pose(up_deg=view.up_deg, footprint_m=view.footprint_m, covariance_m2=(variance_m2, 0.0, variance_m2))
    return replace(frame, position=position, pose=pose)
