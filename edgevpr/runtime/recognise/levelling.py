"""Levelling: takes the distortion of a lens away, and warps the picture of a camera that looks straight down as if the
aircraft flew level. A wrong height scales a picture wrongly; a technique with `height_ratios` recognises it anyway.
"""

import logging
import math
from dataclasses import dataclass, field, replace

from edgevpr.core.arrays import Mask
from edgevpr.core.config import SourceConfig
from edgevpr.core.contract import Technique
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import offset_position, picture_axes
from edgevpr.core.types import Frame, Pose, Position, Vehicle
from edgevpr.frames.lens import CalibratedLens, compute_lens_view, read_lens
from edgevpr.frames.level import (
    STRAIGHT_DOWN,
    UNKNOWN_VIEW,
    Lens,
    LevelledImage,
    Mount,
    View,
    compute_footprint,
    enlarge_image,
    estimate_tilted_view,
    level_image,
    undistort_frame,
)
from edgevpr.frames.source import is_live
from edgevpr.places.layers import Layers

GPS_SD_M = 5.0  # standard deviation along one axis of a recorded position, unless a better one is known
# Distance, as a share of the footprint, from the picture's middle to the point below an aircraft tilted by 3 degrees.
# Chosen on generated flights and aerial_swindale.
TILT_SD_WITHOUT_ATTITUDE = 0.04
_MAX_OFFSET_WITHOUT_HEADING = 0.25  # of the longest side: farther from the aircraft, the picture shows other ground
_MAX_FIELD_DIFFERENCE_DEG = 5.0  # that of a data sheet is rounded

_log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class Levelling:
    """Levels the pictures of a camera that looks straight down, see `frames.level`. Without a `lens` they stay as they
    are, and only the distance on the ground from the point below the camera to the picture's middle is computed, by the
    `mount` of the camera; a `lens` has its own.

    With `below`, for places, the point below the camera becomes the middle. `on_gimbal`: a gimbal keeps the camera
    level. `is_live` is False for recorded frames, for which the autopilot's reports do not hold.
    """

    lens: Lens | None = field(kw_only=False)
    below: bool = False
    on_gimbal: bool = False
    is_live: bool
    mount: Mount = STRAIGHT_DOWN
    _has_warned: bool = field(default=False, init=False)

    def replace_mount(self, mount: Mount) -> "Levelling":
        """Return the same for a camera that is mounted otherwise."""
        return replace(self, lens=self.lens and replace(self.lens, mount=mount), mount=mount)

    def prepare(
        self,
        frame: Frame,
        vehicle: Vehicle | None,
        overlay: Mask | None,
        *,
        layers: Layers | None = None,
        scale: float = 1.0,
    ) -> LevelledImage:
        """Level the picture of a frame. `vehicle` is the autopilot's report (None: unknown). `overlay`, bool (H, W), is
        False where the picture shows no ground (None: nowhere). Its longest side is scaled to a length on the ground,
        that of the places to look among by their `layers` (None: no scaling). It shows `scale` times as much ground as
        its height tells or, where that is unknown, as those of the map."""
        if vehicle and not (self.is_live and vehicle.is_fresh(frame.t_mono_s)):
            vehicle = None
        if vehicle and self.on_gimbal:
            vehicle = replace(vehicle, roll_deg=0.0, pitch_deg=0.0)
        if self.lens is None:
            return enlarge_image(
                LevelledImage(frame.image, overlay, estimate_tilted_view(frame, vehicle, self.mount)), scale
            )
        own_m = compute_footprint(frame, vehicle, self.lens) if layers else None
        footprint_m = layers.choose_footprint(own_m and scale * own_m) if layers else None
        picture = level_image(frame, vehicle, self.lens, footprint_m, overlay=overlay, below=self.below, scale=scale)
        if picture.view.reason and not self._has_warned:
            self._has_warned = True
            _log.warning("%s: %s; no more of these are reported", frame.name, picture.view.reason)
        return picture


@dataclass(frozen=True, slots=True)
class Undistortion:
    """Takes the distortion of a lens from the pictures of a camera that looks ahead, which are not levelled."""

    lens: CalibratedLens

    def prepare(self, frame: Frame, vehicle: Vehicle | None, overlay: Mask | None, **_: object) -> LevelledImage:
        """Straighten the picture of a frame, which has no scale; as `Levelling.prepare`."""
        return undistort_frame(frame.image, overlay, UNKNOWN_VIEW, self.lens)


def make_levelling(
    config: SourceConfig, technique: Technique, *, below: bool = False
) -> Levelling | Undistortion | None:
    """Make what comes before encoding for a configuration. None: nothing, for a camera that looks ahead, or on a gimbal
    with unknown lens. Raises ConfigError for a calibration of the lens that cannot be used, and UsageError for a field
    of view that contradicts it."""
    if technique.spec.parameters.get("camera") != "nadir":
        calibrated = load_calibrated_lens(config)
        return Undistortion(calibrated) if calibrated else None
    lens, mount = read_camera_lens(config), read_mount(config)
    if lens is None:
        _log.info("no correction for tilt, height or heading: set source.fov_deg (--fov-deg)")
        if config.gimbal and mount == STRAIGHT_DOWN:
            return None
    return Levelling(lens, below=below, on_gimbal=config.gimbal, is_live=is_live(config.uri), mount=mount)


def read_camera_lens(config: SourceConfig) -> Lens | None:
    """Return the lens of a configuration's camera; None if it is unknown. Raises as `make_levelling`."""
    calibrated = load_calibrated_lens(config)
    fov_deg = compute_lens_view(calibrated, calibrated.size_px).fov_deg if calibrated else config.fov_deg
    return None if fov_deg is None else Lens(fov_deg, config.up_deg, calibrated, read_mount(config))


def read_mount(config: SourceConfig) -> Mount:
    """Return where a configuration's camera looks beside straight down."""
    return Mount(config.mount_ahead_deg, config.mount_right_deg)


def load_calibrated_lens(config: SourceConfig) -> CalibratedLens | None:
    """Read the calibration that the configuration names (None: it names none); raises as `make_levelling`."""
    if config.lens is None:
        return None
    lens = read_lens(config.lens)
    full_fov_deg = compute_lens_view(lens, lens.size_px).full_fov_deg
    if config.fov_deg is not None and abs(config.fov_deg - full_fov_deg) > _MAX_FIELD_DIFFERENCE_DEG:
        raise UsageError(
            f"`source.fov_deg` is {config.fov_deg:g}, but it is {full_fov_deg:.0f} in {config.lens}: leave `fov_deg` "
            "out, or give the calibration of this camera."
        )
    return lens


def set_picture_heading(frame: Frame, view: View) -> Frame:
    """Return the frame with the heading of the top of its levelled picture, for the hints, if that is known."""
    return frame if view.up_deg is None else replace(frame, heading_deg=view.up_deg)


def centre_place(frame: Frame, view: View) -> Frame:
    """Change a frame to what a place stores. Its heading becomes that of the levelled picture. If it has a position,
    this becomes the position of the picture's middle instead of the aircraft's, as far as that can be computed, and
    with a known height and heading it gets a pose."""
    frame = set_picture_heading(frame, view)
    if view.nadir_offset and view.up_deg is None and math.hypot(*view.nadir_offset) > _MAX_OFFSET_WITHOUT_HEADING:
        return replace(frame, position=None)
    if frame.position and view.nadir_offset_m:
        east_m, north_m = view.nadir_offset_m
        middle = offset_position(frame.position.lat_deg, frame.position.lon_deg, -east_m, -north_m)
        return replace(frame, position=Position(*middle, frame.position.alt_m))
    if frame.pose is not None or frame.position is None or view.up_deg is None or view.footprint_m is None:
        return frame
    variance_m2, position = GPS_SD_M**2, frame.position
    if view.nadir_offset is None:
        variance_m2 += (TILT_SD_WITHOUT_ATTITUDE * view.footprint_m) ** 2
    else:
        # The nadir is below the aircraft, and the picture's middle as far from it in the opposite direction.
        variance_m2 += (view.nadir_offset_sd * view.footprint_m) ** 2
        off_m = -view.footprint_m * picture_axes(view.up_deg) @ view.nadir_offset
        position = Position(*offset_position(position.lat_deg, position.lon_deg, *off_m.tolist()), position.alt_m)
    pose = Pose(up_deg=view.up_deg, footprint_m=view.footprint_m, covariance_m2=(variance_m2, 0.0, variance_m2))
    return replace(frame, position=position, pose=pose)
