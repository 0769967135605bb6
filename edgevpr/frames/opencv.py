"""OpenCV with its own chatter turned off: what goes wrong is said once, in edgevpr's words.

The rest of the runtime takes `cv2` from here. Whoever wants the chatter back sets OPENCV_LOG_LEVEL or
OPENCV_FFMPEG_LOGLEVEL before the start.
"""

import os

import cv2

if "OPENCV_LOG_LEVEL" not in os.environ:
    # OpenCV 4 has the function at the top, OpenCV 5 in a module of its own; 0 is silent in both.
    (getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel)(0)

# Both are read when the first stream or camera is opened, not at import.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET
os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "3")  # seconds; a camera that hangs holds a read for 10

__all__ = ["cv2"]
