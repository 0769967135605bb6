"""OpenCV with its own log messages turned off: edgevpr reports each fault once, in its own words.

All modules that read pictures or streams import `cv2` from here. To get the messages back, set OPENCV_LOG_LEVEL
before the start.
"""

import os

import cv2

if "OPENCV_LOG_LEVEL" not in os.environ:
    # OpenCV 4 has the function in `cv2`, OpenCV 5 in a submodule; level 0 is silent in both.
    (getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel)(0)

# Read when the first camera is opened, not at import.
os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "3")  # seconds; else a hung camera blocks a read for 10 s

__all__ = ["cv2"]
