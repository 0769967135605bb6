"""Pictures in which their number can be read from the pixels, in every band of rows."""

import zlib

import cv2
import numpy as np

WIDTH = 320
HEIGHT = 240
_BAND_PX = 16
_BAR_PX = 16
_NUMBER_BITS = 12
_CHECK_BITS = 8


def _draw_texture() -> np.ndarray:
    noise = np.random.default_rng(1).integers(0, 256, (1024, 1024)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip((smooth - smooth.mean()) * 6 + 128, 0, 255).astype(np.uint8)


_GROUND = _draw_texture()


def _draw_bars(number: int) -> tuple[int, ...]:
    grey = (number ^ (number >> 1)) & (2**_NUMBER_BITS - 1)
    word = grey << _CHECK_BITS | zlib.crc32(grey.to_bytes(2, "big")) & (2**_CHECK_BITS - 1)
    return tuple((word >> bit) & 1 for bit in reversed(range(_NUMBER_BITS + _CHECK_BITS)))


_NUMBERS = {_draw_bars(number): number for number in range(2**_NUMBER_BITS)}


def draw_picture(number: int) -> np.ndarray:
    """Return the picture of this number, (240, 320, 3) BGR: ground that moves by, and in every band of rows the number
    as a code of bars with its check."""
    y, x = 2 * number % 700, 3 * number % 700
    grey = _GROUND[y : y + HEIGHT, x : x + WIDTH].copy()
    row = np.repeat(np.where(_draw_bars(number), 215, 40).astype(np.uint8), _BAR_PX)
    for top in range(0, HEIGHT, _BAND_PX):
        grey[top + _BAND_PX // 2 : top + _BAND_PX] = row
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)


def read_numbers(image: np.ndarray) -> list[int | None]:
    """Return the number in every band of rows; None for a band whose bars are damaged."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    bands = grey.reshape(HEIGHT // _BAND_PX, _BAND_PX, WIDTH // _BAR_PX, _BAR_PX)[:, 10:14, :, 4:12]
    return [_NUMBERS.get(tuple(int(bar) for bar in bars)) for bars in bands.mean((1, 3)) > 128]
