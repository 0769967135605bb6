"""Advice on the pictures of a flight before a map is made of them: where the camera looks, whether a display is drawn
over the pictures, and what the map will lack.

Neighbouring pictures of a camera that looks ahead grow, and are neither turned nor moved up or down. Those of one that
looks straight down move in any direction, and turn. A few pairs of neighbours are compared by their landmarks.

The edges of moving ground point anywhere, so they vanish in the mean of many pictures. Those of a display, or of the
aircraft itself, stay.
"""

import logging
from collections.abc import Iterable, Iterator
from contextlib import closing, suppress
from itertools import islice, pairwise
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.arrays import Bools, Image, Singles
from edgevpr.core.config import SourceConfig
from edgevpr.core.contract import Technique
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.text import show_elapsed
from edgevpr.frames.exif import read_exif, read_fov_deg, read_xmp
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.mask import OverlayMask
from edgevpr.frames.positions import find_positions, find_track, read_positions, read_track
from edgevpr.frames.source import Source, open_source, read_to_end
from edgevpr.mapmaking.pictures import FlownPictures
from edgevpr.mapmaking.tilt import MAX_UNKNOWN_TILT_DEG, measure_tilt
from edgevpr.runtime.recognise.agreement import MIN_PROVEN_INLIERS, measure_agreement
from edgevpr.runtime.recognise.calibration import MIN_PLACES
from edgevpr.runtime.recognise.landmarks import detect_landmarks

_log = logging.getLogger(__name__)
_RUN_COUNT = 6  # of neighbouring pictures that are compared, spread over the folder
_RUN_LENGTH = 3
_TILT_RUN_LENGTH = 12  # those of a video are so close together that only every third or fourth has moved
_VIDEO_PICTURES = 10  # of a video, a second apart
_TILT_VIDEO_PICTURES = 60
_MAX_LANDMARKS = 500
# Limits chosen on corridor and grief_stromovka_seasons (ahead: turned by 12 degrees and moved up by 0.07 at most), and
# on aerial_caliterra and aerial_garfield28. Turning on the spot moves pictures aside too: nearly all must be.
_MIN_TURN_DEG = 15.0
_MIN_UP_SHARE = 0.1
_MIN_ASIDE_SHARE = 0.3
_MAX_GROWTH_ASIDE = 0.03
_MIN_CLEAR_PAIRS = 3  # pairs that are turned or moved up, and their share of all that show the same ground
_MIN_CLEAR_SHARE = 0.2
_MIN_PAIRS = 6  # the same, together with those moved aside
_MIN_SHARE = 0.75
_MAX_DOWN_DEG = 25.0  # tilt of a gimbal from straight down
_MIN_AHEAD_DEG = 45.0
_MAX_USEFUL_HZ = 4.0  # more places a second of a video show nearly the same
_DISPLAY_SHAPE = 240, 320  # rows and columns of the small pictures in which a display is looked for
_DISPLAY_PICTURES = 24  # spread over all
_MIN_DISPLAY_PICTURES = 12  # fewer say nothing
_MIN_EDGE = 5.0  # grey levels a pixel: weaker ones are noise
_MIN_KEPT_SHARE = 0.9  # of the strength of an edge that is left in the mean, from which on it stands still
# Of the pixels. A display has 0.03 to 0.04, two figures and a cross alone 0.006 to 0.009. Of the sets, those from the
# air have 0.0003 at most, and nordland_tiny, with its rails, 0.005. In corridor, whose walls run along the picture's
# edges, 0.09 stand still.
_MIN_DISPLAY_SHARE = 0.006
_MAX_STILL_EDGES = 0.5  # share of all edges: with more the camera itself stood still


def warn_of_gaps(pictures: FlownPictures, total: int, places: int | None) -> None:
    """Warn of what the map will lack. `total`: number of frames (0: unknown). `places`: number of places in the map
    already (None: the map is not to be calibrated)."""
    uri, is_placed = pictures.source, (pictures.positions or find_track(pictures.source)) is not None
    if pictures.folder:
        table = pictures.positions or find_positions(uri)
        tags = read_positions(table) if table else {}
        paths = [path for run in _choose_runs(pictures.folder) for path in run]
        is_placed = any((tags.get(path.name) or read_exif(path)).position for path in paths)
    elif not pictures.rate_hz:
        with closing(_open_video(uri)) as film:
            lasts_s = film.total
        if total > _MAX_USEFUL_HZ * lasts_s:
            text = "every frame of %s becomes a place, %d in %d s: --rate-hz 1 makes %d"
            _log.warning(text, uri, total, lasts_s, lasts_s)
    if not is_placed:
        _log.warning(
            "no position was found, and without one no fix can be sent: run edgevpr positions %s --images %s",
            next(Path(uri).parent.glob(f"{Path(uri).stem}.[sS][rR][tT]"), "LOG_OR_TRACK"),
            uri,
        )
    if total and places is not None and total + places < MIN_PLACES:
        text = "%d places at most: a map of fewer than %d cannot be calibrated, and finds little: give more pictures"
        _log.warning(text, total + places, MIN_PLACES)


def suggest_lens(pictures: FlownPictures, config: SourceConfig, technique: Technique) -> None:
    """Log the field of view of the lens by the EXIF data of a picture, if it is not configured: without it pictures of
    a camera that looks down are neither untilted nor scaled."""
    is_needed = technique.spec.parameters.get("camera") == "nadir" and config.fov_deg is None and config.lens is None
    if (
        is_needed
        and pictures.folder
        and (fov_deg := read_fov_deg(next(iter(list_images(pictures.folder))))) is not None
    ):
        text = "EXIF: field of view about %.0f deg: with --fov-deg %.0f, here and in flight, positions are finer"
        _log.info(text, fov_deg, fov_deg)


@show_elapsed("looking where the camera looks")
def require_forward_camera(pictures: FlownPictures, mask: OverlayMask | None) -> None:
    """Log that the camera is taken to look ahead, and why. Raises UsageError if the pictures clearly look straight
    down: the user must say then what is meant."""
    tilt_deg = _read_gimbal_tilt_deg(pictures.folder) if pictures.folder else None
    if tilt_deg is not None and not _MAX_DOWN_DEG < tilt_deg < _MIN_AHEAD_DEG:
        is_down, why = tilt_deg <= _MAX_DOWN_DEG, f"XMP data: {tilt_deg:.0f} degrees from straight down"
    else:
        is_down, why = _compare_neighbours(pictures, mask)
    if is_down:
        raise UsageError(
            f"These pictures look straight down ({why}): give --camera nadir, or --camera forward if they look ahead."
        )
    _log.info("the camera is taken to look ahead (%s): give --camera nadir if it looks straight down", why)


@show_elapsed("measuring the tilt of the camera")
def require_level_camera(pictures: FlownPictures, fov_deg: float | None) -> None:
    """Raise UsageError if neighbouring pictures show that a camera that is to look straight down is tilted, and its
    angles are not recorded: then nothing could level them."""
    if pictures.folder:
        paths = [path for run in _choose_runs(pictures.folder, _TILT_RUN_LENGTH) for path in run]
        table = pictures.positions or find_positions(pictures.source)
        tags = read_positions(table) if table else {}
        if any(tag.pitch_deg is not None for path in paths for tag in (tags.get(path.name), read_xmp(path)) if tag):
            return
        tilt = measure_tilt(_read_usable(paths), fov_deg)
    else:
        table = pictures.positions or find_track(pictures.source)
        if table and any(tag.pitch_deg is not None for tag in read_track(table).tags):
            return
        tilt = measure_tilt(_read_video(pictures.source, _TILT_VIDEO_PICTURES), fov_deg)
    if tilt and tilt.deg > MAX_UNKNOWN_TILT_DEG:
        raise UsageError(
            f"The camera is tilted by {tilt.deg:.0f} degrees or more from straight down (by {tilt.pairs} pairs of "
            "neighbouring images), and no angles are recorded: every position would be far off. Add roll_deg and "
            "pitch_deg to the table of positions and give --fov-deg, or give --camera forward."
        )


def _compare_neighbours(pictures: FlownPictures, mask: OverlayMask | None) -> tuple[bool, str]:
    """Compare neighbouring pictures. Returns whether they clearly look down, and what was found, as text."""
    folder = pictures.folder
    runs = map(_read_usable, _choose_runs(folder)) if folder else [_read_video(pictures.source, _VIDEO_PICTURES)]
    pairs, clear, aside = 0, 0, 0
    for run in runs:
        marks = [detect_landmarks(image, mask.fit_to(image) if mask else None, _MAX_LANDMARKS) for image in run]
        for seen in (measure_agreement(one, other) for one, other in pairwise(marks)):
            if (
                seen.inliers < MIN_PROVEN_INLIERS
                or seen.shift_share is None
                or seen.rotation_deg is None
                or seen.scale is None
            ):
                continue
            pairs += 1
            if abs(wrap_deg(seen.rotation_deg)) >= _MIN_TURN_DEG or abs(seen.shift_share[1]) >= _MIN_UP_SHARE:
                clear += 1
            elif abs(seen.shift_share[0]) >= _MIN_ASIDE_SHARE and abs(seen.scale - 1) <= _MAX_GROWTH_ASIDE:
                aside += 1
    is_down = clear >= max(_MIN_CLEAR_PAIRS, _MIN_CLEAR_SHARE * pairs) or clear + aside >= max(
        _MIN_PAIRS, _MIN_SHARE * pairs
    )
    return is_down, f"of {pairs} pairs of neighbours, {clear} are turned or moved up or down, and {aside} aside"


@show_elapsed("looking for a display")
def warn_of_display(pictures: FlownPictures, mask: OverlayMask | None) -> None:
    """Warn if something stands still in the pictures where `mask` shows ground (None: everywhere)."""
    if pictures.folder:
        paths = list_images(pictures.folder)
        spread = np.unique(np.linspace(0, len(paths) - 1, _DISPLAY_PICTURES, dtype=int))
        images = _read_usable(paths[at] for at in spread)
    else:
        images = _read_video(pictures.source, _DISPLAY_PICTURES)
    share = measure_still_share(images, mask)
    if share is not None and share >= _MIN_DISPLAY_SHARE:
        text = (
            "%.1f %% of the picture stands still from picture to picture, as a display or a part of the aircraft does: "
            "places are then taken for one another, or none is accepted. Black it out by --mask PNG, also in flight"
        )
        _log.warning(text, 100 * share)


def measure_still_share(images: Iterable[Image], mask: OverlayMask | None) -> float | None:
    """Return the share (0..1) of the pixels of `images` that lie on an edge that stands still, where `mask` shows
    ground (None: everywhere). None if they are too few to tell, or if the camera itself stood still."""
    count, allowed = 0, np.ones(_DISPLAY_SHAPE, bool)
    x, y, strength = np.zeros((3, *_DISPLAY_SHAPE), np.float32)
    for image in images:
        across, along = _compute_gradients(image)
        x, y, strength, count = x + across, y + along, strength + cv2.magnitude(across, along), count + 1
        allowed &= _shrink_mask(mask.fit_to(image)) if mask else True
    if count < _MIN_DISPLAY_PICTURES:
        return None
    edges = allowed & (strength >= _MIN_EDGE * count)
    still = edges & (cv2.magnitude(x, y) >= _MIN_KEPT_SHARE * strength)
    return None if still.sum() > _MAX_STILL_EDGES * edges.sum() else float(still.mean())


def _compute_gradients(image: Image) -> tuple[Singles, Singles]:
    """Return how much a small copy of a picture brightens a pixel, to the right and down: float32 (H, W) each."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    grey = cv2.resize(grey.astype(np.float32), _DISPLAY_SHAPE[::-1], interpolation=cv2.INTER_AREA)
    across, along = (cv2.Sobel(grey, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
    return np.asarray(across, np.float32), np.asarray(along, np.float32)


def _shrink_mask(allowed: Bools) -> Bools:
    return cv2.resize(allowed.view(np.uint8), _DISPLAY_SHAPE[::-1], interpolation=cv2.INTER_NEAREST).astype(bool)


def _open_video(uri: str) -> Source:
    return open_source(uri, step_s=1.0, live=False)


def _read_video(uri: str, count: int) -> Iterator[Image]:
    """Yield the first `count` usable pictures of a video, a second apart."""
    with closing(_open_video(uri)) as film:
        yield from (frame.image for frame in islice(filter(None, read_to_end(film, lambda error: None)), count))


def _read_usable(paths: Iterable[Path]) -> Iterator[Image]:
    for path in paths:
        with suppress(ImageError):
            yield read_image(path)


def _choose_runs(folder: Path, length: int = _RUN_LENGTH) -> list[list[Path]]:
    """Choose runs of neighbouring pictures, spread over a folder; none comes twice."""
    paths = list_images(folder)
    if len(paths) <= _RUN_COUNT * length:
        return [paths]
    starts = np.linspace(0, len(paths) - length, _RUN_COUNT).astype(int).tolist()
    return [paths[start : start + length] for start in starts]


def _read_gimbal_tilt_deg(folder: Path) -> float | None:
    """Return how far a camera on a gimbal is from straight down, by the XMP data of some pictures; None: unknown."""
    tags = [read_xmp(path) for run in _choose_runs(folder) for path in run]
    tilts_deg = [max(abs(tag.roll_deg or 0.0), abs(tag.pitch_deg)) for tag in tags if tag.pitch_deg is not None]
    return float(np.median(tilts_deg)) if tilts_deg else None
