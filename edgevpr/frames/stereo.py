"""Detects stereo images, whose two halves show the same scene, side by side or one above the other. Such an image
is matched with only part of its area, which would make positions wrong by tens of metres."""

import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.core.errors import ImageError
from edgevpr.frames.images import cv2, resize

_HALVES = ("left and right", "upper and lower")
_COPY_PX = (128, 96)  # width and height of the copy that is compared
_DETAIL_SIGMA_PX = 3.0  # brightness over longer distances may be similar in halves that show different scenes
_MAX_SHIFT_FRACTION = 0.125  # of the width of a half, between the left and right views
_MAX_OFFSET_FRACTION = 0.04  # of its height, due to the mounting of the lenses
_PEAK_RADIUS_PX = 4.0
# Chosen on 975 images of 14 sets and on stereo images made from them with a different exposure, half a degree of
# rotation, shifts, scaling and noise: 96 % of these reach both, and no ordinary image does (closest: 0.46, 0.13).
_MIN_CORRELATION = 0.5
_MIN_LEAD = 0.15  # over correlations away from the peak; roads and crop rows do not have such a lead
_MIN_DETAIL_LEVELS = 1.5  # standard deviation in grey levels; halves with less cannot be compared
_STEREO_TO_DECIDE = 5  # required excess of stereo over single images
_SINGLES_TO_DECIDE = 10  # required excess of single images, after which the check stops


class StereoCheck:
    """Compares the halves of the first images of one source until it is clear whether they are stereo images. Every
    image whose halves match is rejected immediately."""

    def __init__(self) -> None:
        self._evidence = 0  # above zero: stereo
        self._is_stereo = False
        self._matching_halves: list[str] = []  # the halves that last matched

    def refuse_stereo(self, image: Image) -> Image:
        """Return the image, uint8 (H, W[, 3]), unchanged. Raises ImageError if its halves show the same scene."""
        if self._evidence == -_SINGLES_TO_DECIDE:
            return image
        scores = {side: correlate_halves(image, side) for side in _HALVES}
        matching = [side for side, (best, lead) in scores.items() if best >= _MIN_CORRELATION and lead >= _MIN_LEAD]
        has_detail = all(best > 0 for best, _ in scores.values())
        is_single = has_detail and all(best < _MIN_CORRELATION for best, _ in scores.values())
        self._evidence = min(self._evidence + bool(matching) - is_single, _STEREO_TO_DECIDE)
        self._matching_halves = matching or self._matching_halves
        self._is_stereo = self._evidence == _STEREO_TO_DECIDE or (self._is_stereo and self._evidence > 0)
        if matching or self._is_stereo:
            raise ImageError(
                f"The {self._matching_halves[0]} halves of the picture show the same scene, as from a stereo camera: "
                "use only one half, with a videocrop pipeline (docs/how-to/cameras.md) or cropped images."
            )
        return image


def correlate_halves(image: Image, side: str) -> tuple[float, float]:
    """Return the largest correlation, 0 to 1, between two halves of an image over the shifts that a stereo camera
    causes, and its lead over all others; 0 and 0 if there is too little detail. `side`: one of `_HALVES`."""
    is_vertical = side == _HALVES[1]
    copy = resize(image, _COPY_PX)
    grey = copy if copy.ndim == 2 else copy[:, :, 1]
    halves = np.array_split(grey.astype(np.float32), 2, 0 if is_vertical else 1)
    first, second = (half - cv2.GaussianBlur(half, (0, 0), _DETAIL_SIGMA_PX) for half in halves)
    height, width = first.shape
    dy, dx = height // 4, width // 4
    middle = second[dy:-dy, dx:-dx]
    if middle.std() < _MIN_DETAIL_LEVELS:
        return 0.0, 0.0
    correlations = cv2.matchTemplate(first, middle, cv2.TM_CCOEFF_NORMED)
    rows, columns = np.indices(correlations.shape)
    is_usable = (abs(rows - dy) <= _MAX_OFFSET_FRACTION * height) & (abs(columns - dx) <= _MAX_SHIFT_FRACTION * width)
    row, column = np.unravel_index(np.argmax(np.where(is_usable, correlations, -1)), correlations.shape)
    is_off_peak = np.hypot(rows - row, columns - column) > _PEAK_RADIUS_PX
    best = max(0.0, float(correlations[row, column]))
    return best, best - float(correlations[is_off_peak].max())
