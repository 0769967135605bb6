"""Real pictures of which little is left: covered, out of focus, smeared, washed out."""

from collections.abc import Callable

import cv2
import numpy as np
from hostile_nothing import display, grained

Spoil = Callable[[np.random.Generator, np.ndarray], np.ndarray]


def _out_of_focus(rng, picture):
    return cv2.GaussianBlur(picture, (0, 0), picture.shape[1] * rng.uniform(0.01, 0.08))


def _half_covered(rng, picture):
    """Cover half or more of a picture from one side, black or grey."""
    covered, share = picture.copy(), rng.uniform(0.5, 0.9)
    height, width = picture.shape[:2]
    rows, columns = (slice(int(share * height)), slice(None)), (slice(None), slice(int(share * width)))
    covered[rows if rng.random() < 0.5 else columns] = int(rng.choice((0, 20, 128)))
    return covered if rng.random() < 0.5 else np.ascontiguousarray(covered[::-1, ::-1])


def _strut(rng, picture):
    """Lay struts across a picture."""
    covered = picture.copy()
    height, width = picture.shape[:2]
    for _ in range(int(rng.integers(1, 4))):
        ends = (int(rng.integers(width)), 0), (int(rng.integers(width)), height)
        cv2.line(covered, *ends, int(rng.integers(0, 60)), max(2, int(width * rng.uniform(0.08, 0.3))))
    return covered


def _finger(rng, picture):
    """Lay something blurred and bright over most of a picture."""
    height, width = picture.shape[:2]
    shape = np.zeros((height, width), np.float32)
    middle = int(rng.uniform(0.2, 0.8) * width), int(rng.uniform(0.2, 0.8) * height)
    cv2.ellipse(shape, middle, (int(0.45 * width), int(0.5 * height)), rng.uniform(0, 180), 0, 360, 1, -1)
    shape = cv2.GaussianBlur(shape, (0, 0), width / 20)
    shape = shape if picture.ndim == 2 else shape[..., None]
    return (picture * (1 - shape) + rng.uniform(60, 160) * shape).astype(np.uint8)


def _smeared(rng, picture):
    """Smear a picture along a line, as a fast turn does."""
    side = max(5, int(picture.shape[1] * rng.uniform(0.05, 0.25)))
    angle = rng.uniform(0, np.pi)
    kernel, half = np.zeros((side, side), np.float32), side / 2 * np.array([np.cos(angle), np.sin(angle)])
    ends = (tuple(np.rint(side / 2 + sign * half).astype(int).tolist()) for sign in (-1, 1))
    cv2.line(kernel, *ends, 1)
    return cv2.filter2D(picture, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


def _washed_out(rng, picture):
    return np.clip(picture * rng.uniform(2, 8), 0, 255).astype(np.uint8)


def _nearly_dark(rng, picture):
    return grained(picture * rng.uniform(0.01, 0.06), rng, rng.uniform(0.5, 3))


def _foggy(rng, picture):
    return grained(picture * rng.uniform(0.01, 0.08) + rng.uniform(100, 200), rng, rng.uniform(0.5, 3))


def _noisy(rng, picture):
    return grained(picture, rng, rng.uniform(30, 120))


def _upside_down(rng, picture):
    return np.ascontiguousarray(picture[::-1, ::-1])


def _mostly_display(rng, picture):
    """Draw a display over a picture that is nearly dark."""
    dark = _nearly_dark(rng, picture)
    return display(dark if dark.ndim == 3 else cv2.cvtColor(dark, cv2.COLOR_GRAY2BGR), rng)


SPOILT: dict[str, Spoil] = {
    "out of focus": _out_of_focus,
    "half covered": _half_covered,
    "strut": _strut,
    "finger": _finger,
    "smeared": _smeared,
    "washed out": _washed_out,
    "nearly dark": _nearly_dark,
    "foggy": _foggy,
    "noisy": _noisy,
    "upside down": _upside_down,
    "display on it": _mostly_display,
}
