"""Looking at the pictures of a flight before a map is made of them: where the camera looks, and what the map will lack.

Neighbouring pictures of a camera that looks ahead grow, and are neither turned nor moved up or down. Those of one that
looks straight down move in any direction, and turn. A few pairs of neighbours are compared, by their landmarks.
"""

import logging
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import islice, pairwise
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.geodesy import shorter_deg
from edgevpr.core.text import at_work
from edgevpr.frames.exif import fov_deg_of, read_exif, read_xmp
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.mask import Mask
from edgevpr.frames.positions import find_positions, find_track, read_positions
from edgevpr.frames.source import Source, open_source, read_to_end
from edgevpr.runtime.recognise.agreement import PROVEN, agreement
from edgevpr.runtime.recognise.evidence import FEWEST_PLACES
from edgevpr.runtime.recognise.landmarks import describe

_log = logging.getLogger(__name__)
_RUNS, _IN_A_RUN = 6, 3  # runs of neighbouring pictures that are looked at, spread over the folder
_FILMED = 10  # pictures of a video that are looked at, a second apart
_LANDMARKS = 500
# Limits chosen on corridor and grief_stromovka_seasons (ahead: turned by 12 degrees and moved up by 0.07 at most), and
# on aerial_caliterra and aerial_garfield28. Turning on the spot moves pictures aside too: nearly all must be.
_TURNED_DEG, _MOVED_UP, _MOVED_ASIDE, _AS_LARGE = 15.0, 0.1, 0.3, 0.03
_FEWEST, _LEAST_SHARE = 3, 0.2  # pairs that are turned or moved up, and their share of all that show the same ground
_FEWEST_ASIDE, _MOST = 6, 0.75  # the same, together with those moved aside
_DOWN_DEG, _AHEAD_DEG = 25.0, 45.0  # tilt of a gimbal from straight down
_MANY_HZ = 4.0  # more places a second of a video show nearly the same


def say_what_will_lack(uri: str, positions: Path | None, rate_hz: float | None, total: int, places: int | None) -> None:
    """Warn of what the map will lack. `uri`, `positions` and `rate_hz`: see `FlownPictures`. `total`: number of frames
    (0: unknown). `places`: number of those in the map already (None: the map is not to be calibrated)."""
    table = positions or find_track(uri)
    is_placed = table is not None
    if Path(uri).is_dir():
        table = positions or find_positions(uri)
        tags = read_positions(table) if table else {}
        some = [path for run in _runs(list_images(uri)) for path in run]
        is_placed = any((tags.get(path.name) or read_exif(path)).position for path in some)
    elif not rate_hz and total > _MANY_HZ * (lasts_s := _film(uri).total):
        text = "every frame of %s becomes a place, %d in %d s: --rate-hz 1 makes %d"
        _log.warning(text, uri, total, lasts_s, lasts_s)
    if not is_placed:
        _log.warning(
            "no position was found, and without one no fix can be sent: run edgevpr positions %s --images %s",
            next(Path(uri).parent.glob(f"{Path(uri).stem}.[sS][rR][tT]"), "LOG_OR_TRACK"),
            uri,
        )
    if total and places is not None and total + places < FEWEST_PLACES:
        text = "%d places at most: a map of fewer than %d cannot be calibrated, and finds little: give more pictures"
        _log.warning(text, total + places, FEWEST_PLACES)


def say_what_lens(folder: Path) -> None:
    """Log how wide the lens sees by the EXIF data of a picture, for the user to say it: without it pictures are neither
    untilted nor scaled."""
    fov_deg = fov_deg_of(next(iter(list_images(folder))))
    if fov_deg is not None:
        text = (
            "EXIF data say a lens of about %.0f degrees: with --fov-deg %.0f, here and in flight, positions are finer"
        )
        _log.info(text, fov_deg, fov_deg)


@at_work("looking where the camera looks")
def require_ahead(uri: str, mask: Mask | None) -> None:
    """Log that the camera is taken to look ahead, and why. `uri` is a folder of images or a video. Raises UsageError
    if the pictures clearly look straight down: the user must say then what is meant."""
    tilt_deg = _tilt_deg(Path(uri)) if Path(uri).is_dir() else None
    if tilt_deg is not None and not _DOWN_DEG < tilt_deg < _AHEAD_DEG:
        is_down, why = tilt_deg <= _DOWN_DEG, f"XMP data: {tilt_deg:.0f} degrees from straight down"
    else:
        is_down, why = _seen(uri, mask)
    if is_down:
        raise UsageError(
            f"These pictures look straight down ({why}): give --camera nadir, or --camera forward if they look ahead."
        )
    _log.info("the camera is taken to look ahead (%s): give --camera nadir if it looks straight down", why)


def _seen(uri: str, mask: Mask | None) -> tuple[bool, str]:
    """Compare neighbouring pictures. Returns whether they clearly look down, and what was found, as text."""
    found, clearly, aside = 0, 0, 0
    for run in _pictures(uri):
        marks = [describe(image, mask.fitted(image) if mask else None, _LANDMARKS) for image in run]
        for seen in (agreement(one, other) for one, other in pairwise(marks)):
            if seen.inliers < PROVEN or seen.shift_share is None or seen.rotation_deg is None or seen.scale is None:
                continue
            found += 1
            if abs(shorter_deg(seen.rotation_deg)) >= _TURNED_DEG or abs(seen.shift_share[1]) >= _MOVED_UP:
                clearly += 1
            elif abs(seen.shift_share[0]) >= _MOVED_ASIDE and abs(seen.scale - 1) <= _AS_LARGE:
                aside += 1
    is_down = clearly >= max(_FEWEST, _LEAST_SHARE * found) or clearly + aside >= max(_FEWEST_ASIDE, _MOST * found)
    return is_down, f"of {found} pairs of neighbours, {clearly} are turned or moved up or down, and {aside} aside"


def _pictures(uri: str) -> Iterator[list[Image]]:
    """Yield runs of neighbouring pictures of a folder or video. Those that cannot be used are left out."""
    if not Path(uri).is_dir():
        yield list(filmed(uri, _FILMED))
        return
    for run in _runs(list_images(uri)):
        yield list(readable(run))


def filmed(uri: str, most: int) -> Iterator[Image]:
    """Yield the first `most` pictures of a video, a second apart. Those that cannot be used are left out."""
    film = _film(uri)
    yield from (frame.image for frame in islice(filter(None, read_to_end(film, lambda error: None)), most))
    film.close()


def readable(paths: Iterable[Path]) -> Iterator[Image]:
    """Yield the pictures of these files that can be used."""
    for path in paths:
        with suppress(ImageError):
            yield read_image(path)


def _film(uri: str) -> Source:
    return open_source(uri, step_s=1.0, live=False)


def _runs(paths: list[Path]) -> list[list[Path]]:
    """Choose runs of neighbours, spread over `paths`; none comes twice."""
    if len(paths) <= _RUNS * _IN_A_RUN:
        return [paths]
    starts = np.linspace(0, len(paths) - _IN_A_RUN, _RUNS).astype(int).tolist()
    return [paths[start : start + _IN_A_RUN] for start in starts]


def _tilt_deg(folder: Path) -> float | None:
    """Return how far a camera on a gimbal is from straight down, by the XMP data of some pictures; None: unknown."""
    tags = [read_xmp(path) for run in _runs(list_images(folder)) for path in run]
    known = [max(abs(tag.roll_deg or 0.0), abs(tag.pitch_deg)) for tag in tags if tag.pitch_deg is not None]
    return float(np.median(known)) if known else None
