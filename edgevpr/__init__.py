"""edgevpr: visual place recognition for the companion computer of a small drone."""

import os
from importlib import import_module

__version__ = "0.1.0"

# The largest survey cameras that are flown have 100 megapixels (11664 x 8750); decoded that is 300 MB. Without a limit
# a picture of 1 MB, which compresses well, takes gigabytes. OpenCV reads this once, when the first module imports it,
# and then compares it with the header of a picture before any pixel is decoded.
os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = "102100000"

# Loaded when they are asked for: `import edgevpr` and the commands stay light.
_INTERFACE = ("FlightPictures", "Map", "Match", "OrthophotoGrid", "build")


def __getattr__(name: str) -> object:
    if name in _INTERFACE:
        return getattr(import_module("edgevpr.api"), name)
    raise AttributeError(f"module 'edgevpr' has no attribute {name!r}")
