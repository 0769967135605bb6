"""Preparation of a picture as the input of a network, by the `input` of its card."""

import cv2
import numpy as np

from edgevpr.techniques.networks.card import InputRule

_RESIZE = {"area": cv2.INTER_AREA, "linear": cv2.INTER_LINEAR_EXACT, "cubic": cv2.INTER_CUBIC}
_NOTHING_ALLOWED = 128


def prepare(image: np.ndarray, rule: InputRule) -> np.ndarray:
    """Prepare uint8 (H, W) grey or (H, W, 3) BGR as float32 (1, C, height, width), or (1, height, width, C) for NHWC.

    Equalising is that of CALC: BGR to YUV, the histogram of Y equalised, back to BGR, all before the picture is made
    grey and smaller. A grey picture has no U and V: its own histogram is equalised.
    """
    if rule.equalise:
        image = _equalised(image)
    if rule.colour == "grey":
        image = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    elif image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    elif rule.colour == "rgb":
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    image = _sized(image, rule)
    values = np.multiply(image, np.float32(rule.scale), dtype=np.float32).reshape(rule.height, rule.width, -1)
    values -= np.array(rule.mean, np.float32)
    if rule.std is not None:
        values /= np.array(rule.std, np.float32)
    return np.ascontiguousarray(values[None] if rule.layout == "NHWC" else values.transpose(2, 0, 1)[None])


def shares(image: np.ndarray, rule: InputRule) -> tuple[float, float]:
    """Return the shares of the input's width and height that `prepare` fills with the picture; the rest is padding."""
    if rule.pad is None:
        return 1.0, 1.0
    height, width = image.shape[:2]
    scale = min(rule.width / width, rule.height / height)
    return max(1, round(width * scale)) / rule.width, max(1, round(height * scale)) / rule.height


def _sized(image: np.ndarray, rule: InputRule) -> np.ndarray:
    across, down = shares(image, rule)
    width, height = round(across * rule.width), round(down * rule.height)
    image = cv2.resize(image, (width, height), interpolation=_RESIZE[rule.resize])
    if (width, height) == (rule.width, rule.height):
        return image
    border = (0, rule.height - height, 0, rule.width - width)
    return cv2.copyMakeBorder(image, *border, cv2.BORDER_CONSTANT, value=(rule.pad,) * 3)


def without_masked(image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Set every pixel where the bool (H, W) `mask` is False to the mean of the others (128 if there are none). A
    network needs a whole picture, and a uniform patch adds the least to it."""
    if mask is None or mask.all():
        return image
    filled = image.copy()
    filled[~mask] = np.rint(image[mask].mean(axis=0)) if mask.any() else _NOTHING_ALLOWED
    return filled


def _equalised(image: np.ndarray) -> np.ndarray:
    if image.ndim == 2:
        return cv2.equalizeHist(image)
    yuv = cv2.cvtColor(image, cv2.COLOR_BGR2YUV)
    yuv[..., 0] = cv2.equalizeHist(np.ascontiguousarray(yuv[..., 0]))
    return cv2.cvtColor(yuv, cv2.COLOR_YUV2BGR)
