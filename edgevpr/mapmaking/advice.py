"""Checks pictures before a map is made: where the camera points, on-screen displays, and what the map will lack.

From one picture of a forward camera to the next, the scene grows, but neither rotates nor moves up or down. With a
camera that looks straight down, it moves in any direction and rotates. Landmarks of a few neighbouring pairs show this.

The edges of moving ground have random directions, so they cancel out in the mean of many pictures. Those of a display,
or of the aircraft itself, remain.
"""

import logging
from collections.abc import Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.core.config import SourceConfig
from edgevpr.core.contract import Technique
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.text import decode_name, show_elapsed
from edgevpr.core.types import Frame
from edgevpr.frames.exif import read_exif, read_fov_deg, read_xmp
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.level import STRAIGHT_DOWN, Lens, level_image
from edgevpr.frames.mask import OverlayMask
from edgevpr.frames.positions import find_positions, find_track, list_unread_columns
from edgevpr.frames.source import Source, make_frame, open_source, read_table, read_to_end
from edgevpr.mapmaking.pictures import FlightPictures
from edgevpr.mapmaking.tilt import MAX_UNKNOWN_TILT_DEG, measure_tilt
from edgevpr.runtime.recognise.agreement import MIN_PROVEN_INLIERS, measure_agreement
from edgevpr.runtime.recognise.calibration import MIN_PLACES
from edgevpr.runtime.recognise.landmarks import detect_landmarks

_log = logging.getLogger(__name__)
_RUN_COUNT = 6  # runs of neighbouring pictures to compare, spread over the folder
_RUN_LENGTH = 3
_TILT_RUN_LENGTH = 12  # frames of a video are so close together that only every third or fourth shows motion
_VIDEO_PICTURES = 10  # taken from a video, a second apart
_TILT_VIDEO_PICTURES = 60
_MAX_LEVEL_DEG = 5.0
_MAX_REPEATED = 0.8  # of successive images with the same position; three exposures of each make two thirds
_MAX_WRONG_TILT_DEG = 25.0  # from a recorded direction: a slope in one direction looks like a tilt
_MAX_LANDMARKS = 500
# Chosen on corridor and grief_stromovka_seasons (forward: at most 12 degrees and 0.07 of vertical motion), and on
# aerial_caliterra and aerial_garfield28. Yaw moves the scene sideways too, so nearly all pairs must show such motion.
_MIN_ROTATION_DEG = 15.0
_MIN_UP_SHIFT = 0.1
_MIN_SIDEWAYS_SHIFT = 0.3
_MAX_SIDEWAYS_GROWTH = 0.03
_MIN_CLEAR_PAIRS = 3  # pairs with rotation or vertical motion
_MIN_CLEAR_FRACTION = 0.2  # and their fraction of all pairs that show the same ground
_MIN_PAIRS = 6  # the same, including pairs with sideways motion
_MIN_FRACTION = 0.75
_MAX_FOV_RATIO = 1.1  # of one lens: crops of another shape differ by 4 %
_MAX_DOWN_DEG = 25.0  # tilt of a gimbal from straight down
_MIN_FORWARD_DEG = 45.0
_MAX_USEFUL_HZ = 4.0  # places per second of a video; more of them look nearly the same
_DISPLAY_SHAPE = 240, 320  # rows and columns of the reduced pictures in which a display is detected
_DISPLAY_PICTURES = 24  # spread over the whole flight
_MIN_DISPLAY_PICTURES = 12  # fewer pictures are not conclusive
_MIN_EDGE = 5.0  # grey levels per pixel; weaker edges are noise
_MIN_STATIC_FRACTION = 0.9  # of an edge's strength that remains in the mean, if the edge is static
# Fraction of pixels on static edges. A display has 0.03 to 0.04; two numbers and a cross alone have 0.006 to 0.009.
# Aerial sets have at most 0.0003, and nordland_tiny, with its rails, 0.005. In corridor, whose walls run along the
# picture's edges, it is 0.09.
_MIN_DISPLAY_FRACTION = 0.006
_MAX_STATIC_EDGES = 0.5  # fraction of all edges; if more are static, the camera itself did not move


def warn_of_gaps(pictures: FlightPictures, total: int, places: int | None) -> None:
    """Warn about what the map will lack. `total`: number of frames (0: unknown). `places`: number of places already in
    the map (None: the map will not be calibrated)."""
    uri, table = pictures.source, pictures.positions or find_track(pictures.source)
    has_position = table is not None
    if pictures.folder:
        table = pictures.positions or find_positions(pictures.folder)
        tags = read_table(pictures.folder, pictures.positions)
        runs = [
            [(tags.get(decode_name(path.name)) or read_exif(path)).position for path in run]
            for run in _choose_runs(pictures.folder)
        ]
        has_position = any(map(any, runs))
        pairs = [(one, other) for run in runs for one, other in pairwise(run) if one and other]
        repeated = sum((one.lat_deg, one.lon_deg) == (other.lat_deg, other.lon_deg) for one, other in pairs)
        if repeated > _MAX_REPEATED * len(pairs):
            text = "%d of %d images that were compared have exactly the position of the image before: was GPS frozen?"
            _log.warning(text, repeated, len(pairs))
    elif not pictures.rate_hz:
        with closing(_open_video(uri)) as video:
            duration_s = video.total
        if total > _MAX_USEFUL_HZ * duration_s:
            text = "every frame of %s becomes a place (%d in %d s): pass --rate-hz 1 to make only %d"
            _log.warning(text, uri, total, duration_s, duration_s)
    if table and (unread := list_unread_columns(table)):
        text = "%s: not read: %s; columns: lat, lon, alt, yaw_deg (or heading_deg), roll_deg, pitch_deg, height_m"
        _log.warning(text, table, ", ".join(unread))
    if not has_position:
        _log.warning(
            "no positions were found, and no fix can be sent without them: run edgevpr positions %s --images %s",
            next(Path(uri).parent.glob(f"{Path(uri).stem}.[sS][rR][tT]"), "LOG_OR_TRACK"),
            uri,
        )
    if total and places is not None and total + places < MIN_PLACES:
        text = "at most %d places: a map of fewer than %d uses the default confidence model; add pictures"
        _log.warning(text, total + places, MIN_PLACES)


def suggest_lens(pictures: FlightPictures, config: SourceConfig, technique: Technique) -> None:
    """If no field of view is configured, log the one in the pictures' EXIF data: without it, pictures of a camera that
    looks down can be neither levelled nor scaled. Warn if there are several."""
    if technique.spec.parameters.get("camera") != "nadir" or config.fov_deg is not None or config.lens is not None:
        return
    if not (fovs_deg := _read_fovs_deg(pictures)):
        return
    if fovs_deg[-1] > _MAX_FOV_RATIO * fovs_deg[0]:
        text = "EXIF: fields of view from %.0f to %.0f degrees: keep the images of one camera in a folder of their own"
        _log.warning(text, fovs_deg[0], fovs_deg[-1])
    else:
        text = "EXIF: field of view about %.0f deg: pass --fov-deg %.0f, here and in flight, for better positions"
        _log.info(text, fovs_deg[0], fovs_deg[0])


def _read_fovs_deg(pictures: FlightPictures) -> list[float]:
    """Return the fields of view in the EXIF data of the pictures, ascending."""
    paths = list_images(pictures.folder) if pictures.folder else []
    return sorted(fov_deg for fov_deg in map(read_fov_deg, paths) if fov_deg is not None)


@show_elapsed("checking where the camera points")
def require_forward_camera(pictures: FlightPictures, mask: OverlayMask | None) -> None:
    """Log that the camera is assumed to face forward, and why. Raises UsageError if it clearly looks straight down."""
    runs = _choose_runs(pictures.folder) if pictures.folder else []
    tags = [read_xmp(path) for run in runs for path in run]
    tilts_deg = [max(abs(tag.roll_deg or 0.0), abs(tag.pitch_deg)) for tag in tags if tag.pitch_deg is not None]
    tilt_deg = float(np.median(tilts_deg)) if tilts_deg else None
    if tilt_deg is not None and not _MAX_DOWN_DEG < tilt_deg < _MIN_FORWARD_DEG:
        is_down, why = tilt_deg <= _MAX_DOWN_DEG, f"XMP data: tilted {tilt_deg:.0f} degrees from straight down"
    else:
        is_down, why = _compare_neighbours(pictures, mask)
    if is_down:
        raise UsageError(
            f"The camera looks straight down ({why}): pass --camera nadir, or --camera forward if it faces forward."
        )
    _log.info("assuming that the camera faces forward (%s): pass --camera nadir if it looks straight down", why)


@show_elapsed("comparing fields of view")
def require_one_lens(pictures: FlightPictures) -> None:
    """Raise UsageError if the EXIF data of pictures that are to be levelled show different fields of view: with the one
    configured, the others would get a wrong scale."""
    fovs_deg = _read_fovs_deg(pictures)
    if fovs_deg and fovs_deg[-1] > _MAX_FOV_RATIO * fovs_deg[0]:
        raise UsageError(
            f"The images have fields of view from {fovs_deg[0]:.0f} to {fovs_deg[-1]:.0f} degrees (EXIF data), but "
            "are levelled with one: keep those of one camera, without zoom, in a folder of their own."
        )


@show_elapsed("measuring the tilt of the camera")
def require_level_camera(pictures: FlightPictures, lens: Lens | None) -> None:
    """Raise UsageError if neighbouring pictures show that a camera that should look straight down is tilted. With a
    `lens`, they are levelled first by its mount and their recorded angles: a tilt that remains is not recorded, or
    wrongly. Without one, pictures whose recorded angles are not near 0 are not compared."""
    is_recorded = lens is not None and lens.mount != STRAIGHT_DOWN

    def read_level_images() -> Iterator[Image]:
        nonlocal is_recorded
        for frame in _read_tilt_frames(pictures):
            if frame.roll_deg is not None and frame.pitch_deg is not None:
                is_recorded = True
                if lens is None and max(abs(frame.roll_deg), abs(frame.pitch_deg)) > _MAX_LEVEL_DEG:
                    continue
            if lens is None:
                yield frame.image
                continue
            with suppress(ImageError):  # not turned north, so that the direction remains that in the camera
                level = level_image(replace(frame, heading_deg=None), None, lens)
                if level.view.reason is None:
                    yield level.image

    tilt = measure_tilt(read_level_images(), lens.fov_deg if lens else None)
    if tilt is None or tilt.deg <= (_MAX_WRONG_TILT_DEG if is_recorded else MAX_UNKNOWN_TILT_DEG):
        return
    measured = f"by {tilt.deg:.0f} degrees or more (measured from {tilt.pairs} pairs of neighbouring images)"
    if is_recorded:
        raise UsageError(
            f"The camera is tilted {measured} from the direction given by roll_deg (right wing down is positive), "
            "pitch_deg (nose up) and source.mount_*, which are 0 straight down, so every position would be far off. "
            "Correct them; if they are right and the ground is steep, set `source: {gimbal: true}` to skip this check."
        )
    raise UsageError(
        f"The camera is tilted {measured} from straight down, and its angles are not recorded, so every position would "
        "be far off. Add roll_deg and pitch_deg, both, to the position table and pass --fov-deg, or pass --camera "
        "forward."
    )


def _read_tilt_frames(pictures: FlightPictures) -> Iterator[Frame]:
    """Yield some neighbouring pictures with their tags."""
    if pictures.folder:
        tags = read_table(pictures.folder, pictures.positions)
        for path in (path for run in _choose_runs(pictures.folder, _TILT_RUN_LENGTH) for path in run):
            for image in _read_usable([path], upright=False):
                yield make_frame(image, path.name, 0.0, tags.get(decode_name(path.name)) or read_exif(path))
    else:
        with closing(replace(pictures, rate_hz=1.0).open(upright=False)) as video:
            yield from islice(filter(None, read_to_end(video, lambda error: None)), _TILT_VIDEO_PICTURES)


def _compare_neighbours(pictures: FlightPictures, mask: OverlayMask | None) -> tuple[bool, str]:
    """Compare neighbouring pictures. Returns True if they clearly look down, and the reason as text."""
    folder = pictures.folder
    runs = map(_read_usable, _choose_runs(folder)) if folder else [_read_video(pictures.source, _VIDEO_PICTURES)]
    pairs, clear_count, sideways_count = 0, 0, 0
    for run in runs:
        landmarks = [detect_landmarks(image, mask.fit_to(image) if mask else None, _MAX_LANDMARKS) for image in run]
        for match in (measure_agreement(first, second) for first, second in pairwise(landmarks)):
            if (
                match.inliers < MIN_PROVEN_INLIERS
                or match.shift_share is None
                or match.rotation_deg is None
                or match.scale is None
            ):
                continue
            pairs += 1
            if abs(wrap_deg(match.rotation_deg)) >= _MIN_ROTATION_DEG or abs(match.shift_share[1]) >= _MIN_UP_SHIFT:
                clear_count += 1
            elif abs(match.shift_share[0]) >= _MIN_SIDEWAYS_SHIFT and abs(match.scale - 1) <= _MAX_SIDEWAYS_GROWTH:
                sideways_count += 1
    is_clear = clear_count >= max(_MIN_CLEAR_PAIRS, _MIN_CLEAR_FRACTION * pairs)
    is_down = is_clear or clear_count + sideways_count >= max(_MIN_PAIRS, _MIN_FRACTION * pairs)
    return is_down, f"of {pairs} image pairs, {clear_count} rotate or move vertically, {sideways_count} move sideways"


@show_elapsed("checking for an on-screen display")
def warn_of_display(pictures: FlightPictures, mask: OverlayMask | None, *, upright: bool) -> None:
    """Warn if something in the pictures does not move where `mask` shows ground. `upright`: see `open_source`."""
    if pictures.folder:
        paths = list_images(pictures.folder)
        indices = np.unique(np.linspace(0, len(paths) - 1, _DISPLAY_PICTURES, dtype=int))
        images = _read_usable((paths[index] for index in indices), upright=upright)
    else:
        images = _read_video(pictures.source, _DISPLAY_PICTURES)
    fraction = measure_static_fraction(images, mask)
    if fraction is not None and fraction >= _MIN_DISPLAY_FRACTION:
        text = (
            "%.1f %% of the picture never changes: probably a display or a part of the aircraft. It would make places "
            "look alike, so that they are confused or all rejected. Mask it with --mask PNG, here and in flight"
        )
        _log.warning(text, 100 * fraction)


def measure_static_fraction(images: Iterable[Image], mask: OverlayMask | None) -> float | None:
    """Return the fraction (0..1) of the pixels of `images` that are on a static edge, where `mask` shows ground (None:
    everywhere). None if there are too few images, or if the camera itself did not move."""
    count, allowed = 0, np.ones(_DISPLAY_SHAPE, bool)
    x, y, strength = np.zeros((3, *_DISPLAY_SHAPE), np.float32)
    for image in images:
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        grey = cv2.resize(grey.astype(np.float32), _DISPLAY_SHAPE[::-1], interpolation=cv2.INTER_AREA)
        dx, dy = (cv2.Sobel(grey, cv2.CV_32F, x_order, 1 - x_order, scale=1 / 8) for x_order in (1, 0))
        x, y, strength, count = x + dx, y + dy, strength + cv2.magnitude(dx, dy), count + 1
        if mask:
            shown = mask.fit_to(image).view(np.uint8)
            allowed &= cv2.resize(shown, _DISPLAY_SHAPE[::-1], interpolation=cv2.INTER_NEAREST).astype(bool)
    if count < _MIN_DISPLAY_PICTURES:
        return None
    edges = allowed & (strength >= _MIN_EDGE * count)
    static = edges & (cv2.magnitude(x, y) >= _MIN_STATIC_FRACTION * strength)
    return None if static.sum() > _MAX_STATIC_EDGES * edges.sum() else float(static.mean())


def _open_video(uri: str) -> Source:
    return open_source(uri, step_s=1.0, live=False)


def _read_video(uri: str, count: int) -> Iterator[Image]:
    """Yield the first `count` usable pictures of a video, a second apart."""
    with closing(_open_video(uri)) as video:
        yield from (frame.image for frame in islice(filter(None, read_to_end(video, lambda error: None)), count))


def _read_usable(paths: Iterable[Path], *, upright: bool = True) -> Iterator[Image]:
    for path in paths:
        with suppress(ImageError):
            yield read_image(path, upright=upright)


def _choose_runs(folder: Path, length: int = _RUN_LENGTH) -> list[list[Path]]:
    """Choose runs of neighbouring pictures, spread over a folder; no picture is chosen twice."""
    paths = list_images(folder)
    if len(paths) <= _RUN_COUNT * length:
        return [paths]
    starts = np.linspace(0, len(paths) - length, _RUN_COUNT).astype(int).tolist()
    return [paths[start : start + length] for start in starts]
