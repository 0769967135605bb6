"""Notices what stands still in all pictures of a flight: a display drawn over them, or the aircraft itself.

The edges of moving ground point anywhere, so in the mean of many pictures they vanish. One that is drawn stays.
"""

import logging
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.arrays import Bools, Image, Singles
from edgevpr.core.text import at_work
from edgevpr.frames.images import list_images
from edgevpr.frames.mask import Mask
from edgevpr.mapmaking.beforehand import filmed, readable

_log = logging.getLogger(__name__)
_WIDE, _HIGH = 320, 240
_PICTURES, _FEWEST = 24, 12  # that are looked at, spread over all; fewer tell nothing
_EDGE = 5.0  # grey levels a pixel: weaker ones are noise
_KEPT = 0.9  # share of the strength of an edge that is left in the mean, from which on it stands still
# Share of the pixels. A display has .03 to .04, two figures and a cross alone .006 to .009. Of the sets, those from the
# air have .0003 at most, and nordland_tiny, with its rails, .005. In corridor, whose walls run along the picture's
# edges, .09 stand still.
_LEAST = 0.006
_ALL = 0.5  # of all edges: the camera itself stood still


@at_work("looking for a display")
def say_what_stands_still(uri: str, mask: Mask | None) -> None:
    """Warn if something stands still in the pictures of `uri`, a folder of images or a video, where `mask` shows ground
    (None: everywhere)."""
    share = share_still(_pictures(uri), mask)
    if share is not None and share >= _LEAST:
        text = (
            "%.1f %% of the picture stands still from picture to picture, as a display or a part of the aircraft does: "
            "places are then taken for one another, or none is accepted. Black it out by --mask PNG, also in flight"
        )
        _log.warning(text, 100 * share)


def share_still(images: Iterable[Image], mask: Mask | None) -> float | None:
    """Return the share (0..1) of the pixels of `images` that lie on an edge that stands still, where `mask` shows
    ground (None: everywhere). None if they are too few to tell, or if the camera itself stood still."""
    count, allowed = 0, np.ones((_HIGH, _WIDE), bool)
    x, y, strength = np.zeros((3, _HIGH, _WIDE), np.float32)
    for image in images:
        across, along = _edges(image)
        x, y, strength, count = x + across, y + along, strength + cv2.magnitude(across, along), count + 1
        allowed &= _small(mask.fitted(image)) if mask else True
    if count < _FEWEST:
        return None
    edges = allowed & (strength >= _EDGE * count)
    still = edges & (cv2.magnitude(x, y) >= _KEPT * strength)
    return None if still.sum() > _ALL * edges.sum() else float(still.mean())


def _edges(image: Image) -> tuple[Singles, Singles]:
    """Return how much a small copy of a picture brightens a pixel, to the right and down: float32 (high, wide) each."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    grey = cv2.resize(grey.astype(np.float32), (_WIDE, _HIGH), interpolation=cv2.INTER_AREA)
    across, along = (cv2.Sobel(grey, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
    return np.asarray(across, np.float32), np.asarray(along, np.float32)


def _small(allowed: Bools) -> Bools:
    return cv2.resize(allowed.view(np.uint8), (_WIDE, _HIGH), interpolation=cv2.INTER_NEAREST).astype(bool)


def _pictures(uri: str) -> Iterator[Image]:
    """Return pictures spread over a folder, or of the first seconds of a video."""
    if not Path(uri).is_dir():
        return filmed(uri, _PICTURES)
    paths = list_images(uri)
    return readable(paths[at] for at in sorted({*np.linspace(0, len(paths) - 1, _PICTURES).astype(int).tolist()}))
