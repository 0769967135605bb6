"""Reads the pictures that the recipes beside this file learn from."""

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from edgevpr.core.arrays import Array, Image
from edgevpr.core.errors import ImageError
from edgevpr.core.text import progress
from edgevpr.frames.images import cv2, list_images, read_image

_LONGEST_PX = 640  # larger pictures only fill memory: no network here uses more


def read_pictures(folders: Iterable[str | Path], label: str) -> Iterator[Image]:
    """Yield each image of `folders`, uint8 grey or BGR, the longer side at most 640 pixels, and print the progress
    under `label`. An image that cannot be used is named on stderr and left out.

    Raises SourceError for a folder that is missing or holds no images.
    """
    paths = [path for folder in folders for path in list_images(folder)]
    for path in progress(paths, len(paths), label):
        try:
            yield at_most(read_image(path), _LONGEST_PX)
        except ImageError as error:
            print(error, file=sys.stderr)


def at_most(image: Array, longest_px: int) -> Image:
    """Shrink an image whose longer side has more than `longest_px` pixels."""
    shrink = longest_px / max(image.shape[:2])
    small: Array = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else image
    return small
