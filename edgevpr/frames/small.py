"""A picture made small for people to look at."""

import cv2
import numpy as np

_LONGEST_PX = 640
_QUALITY = 80


def small_jpeg(image: np.ndarray, longest_px: int = _LONGEST_PX) -> bytes:
    """Return a picture, uint8, grey or BGR, as a JPEG whose longest side has 640 pixels at most, or `longest_px`."""
    scale = min(1.0, longest_px / max(image.shape[:2]))
    if scale < 1:
        size = tuple(max(1, round(scale * side)) for side in image.shape[1::-1])
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))[1].tobytes()
