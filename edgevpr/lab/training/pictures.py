"""Training pairs of CALC: a changed view of a picture as input, the gradients of the unchanged view as target. Also the
reading of pictures, for all kinds of training.

The pairs follow Merrill and Huang 2018, section III; models/README.md says what differs, and why.
"""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Array, Doubles, Image, Singles
from edgevpr.core.errors import ImageError
from edgevpr.core.text import progress, shown
from edgevpr.frames.images import cv2, list_images, read_image
from edgevpr.techniques.gradients import normalised_blocks, oriented_cells

HEIGHT, WIDTH = 120, 160  # of the network's input
_CELL_PX = 8
_ORIENTATIONS = 9
# 14 x 19 blocks of 2x2 cells.
TARGET_LENGTH = (HEIGHT // _CELL_PX - 1) * (WIDTH // _CELL_PX - 1) * 4 * _ORIENTATIONS
_LONGEST_READ_PX = 640  # larger pictures only fill memory: no network here uses more
_LONGEST_LEARNT_PX = 320  # twice the network's input: enough for a part of a picture
_SMALLEST_PART = 0.85
_CORNER_MOVES = 0.1  # of the sides of the view
_LIGHT_VARIES = 0.5  # standard deviation of the logarithm of the light over the view
_NOISE = 2.0  # largest standard deviation, in grey levels


def read_pictures(
    folders: Sequence[str | Path], label: str, unusable: list[ImageError] | None = None
) -> Iterator[Image]:
    """Yield each image of `folders`, uint8 grey or BGR, the longer side at most 640 pixels, and print the progress
    under `label`. Images that cannot be used are printed to stderr and added to `unusable` (None: they are skipped
    silently, as an earlier pass has reported them).

    Raises SourceError for a folder that is missing or holds no images.
    """
    paths = [path for folder in folders for path in list_images(folder)]
    for path in progress(paths, len(paths), label):
        try:
            yield _at_most(read_image(path), _LONGEST_READ_PX)
        except ImageError as error:
            if unusable is not None:
                print(f"edgevpr: {shown(str(error))}", file=sys.stderr)
                unusable.append(error)


def small_grey(image: Image) -> Image:
    """Convert a uint8 image to the form that `batch` takes: uint8 grey, the longer side at most 320 pixels."""
    grey: Array = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return _at_most(grey, _LONGEST_LEARNT_PX)


def _at_most(image: Array, longest_px: int) -> Image:
    shrink = longest_px / max(image.shape[:2])
    small: Array = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else image
    return small


def batch(pictures: Sequence[Image], size: int, rng: np.random.Generator) -> tuple[Singles, Singles]:
    """Make a random batch: inputs float32 (size, 1, 120, 160) in 0..1, and targets float32 (size, TARGET_LENGTH)."""
    inputs = np.empty((size, 1, HEIGHT, WIDTH), np.float32)
    targets = np.empty((size, TARGET_LENGTH), np.float32)
    for row in range(size):
        sight, changed = two_sights(pictures[int(rng.integers(len(pictures)))], rng)
        inputs[row, 0] = cv2.equalizeHist(changed)
        targets[row] = gradients_of(sight)
    inputs /= 255
    return inputs, targets


def gradients_of(sight: Image) -> Singles:
    """Compute the target, the HOG of a view: uint8 (120, 160) to float32 (TARGET_LENGTH,) in 0..1. Cells are 8x8
    pixels, blocks 2x2 cells with a stride of one cell, orientations 9 over 180 degrees."""
    return normalised_blocks(oriented_cells(sight, _CELL_PX, _ORIENTATIONS, signed=False)).ravel()


def two_sights(picture: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """Return two views of a grey picture, uint8 (120, 160) each: a random part of it, and about the same ground, seen
    from elsewhere in other light."""
    height, width = picture.shape
    largest = min(width / WIDTH, height / HEIGHT)
    scale = largest * rng.uniform(_SMALLEST_PART, 1)
    size = np.array([WIDTH, HEIGHT]) * scale
    corner = rng.uniform(0, 1, 2) * (np.array([width, height]) - size)
    corners = corner + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size
    if rng.random() < 0.5:
        corners = corners[[1, 0, 3, 2]]
    moved = corners + rng.uniform(-_CORNER_MOVES, _CORNER_MOVES, (4, 2)) * size
    return _seen(picture, corners), _relit(_seen(picture, moved), rng)


def _seen(picture: Image, corners: Doubles) -> Image:
    frame = np.array([[0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT]], np.float32)
    to_frame = cv2.getPerspectiveTransform(corners.astype(np.float32), frame)
    sight: Array = cv2.warpPerspective(
        picture, to_frame, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
    )
    return sight


def _relit(sight: Image, rng: np.random.Generator) -> Image:
    """Change gamma, brightness (mostly darker) and light (uneven, as under clouds), and add noise of the sensor."""
    light: Array = rng.normal(0, _LIGHT_VARIES * rng.random(), (3, 4)).astype(np.float32)
    light = np.exp(cv2.resize(light, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC))
    changed = (sight / np.float32(255)) ** np.float32(rng.uniform(0.6, 1.6))
    changed *= light * np.float32(255 * rng.uniform(0.5, 1.1))
    changed += rng.standard_normal(changed.shape, np.float32) * np.float32(rng.uniform(0, _NOISE))
    return np.clip(changed, 0, 255).astype(np.uint8)
