"""edgevpr: visual place recognition for the companion computer of a small drone."""

import os
from importlib import import_module

__version__ = "0.1.0"

# The largest survey cameras on aircraft have 100 megapixels (11664 x 8750), 300 MB decoded. Without a limit a highly
# compressed picture of 1 MB can need gigabytes. OpenCV reads this once, when it is first imported, and compares it with
# the header of a picture before any pixel is decoded.
os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = "102100000"

# Imported on first use, so that `import edgevpr` and the commands stay fast.
_INTERFACE = ("FlightPictures", "Map", "Match", "OrthophotoGrid", "build")


def __getattr__(name: str) -> object:
    if name in _INTERFACE:
        return getattr(import_module("edgevpr.api"), name)
    raise AttributeError(f"module 'edgevpr' has no attribute {name!r}")
