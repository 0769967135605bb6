"""Stretches the contrast of pictures taken in low light or fog, for `cohog`.

Dim ground has as little entropy as a blank wall. Such a picture is smoothed, because stretching amplifies sensor noise,
and then *stretched* to more grey levels. A picture with enough contrast, or almost none, is left unchanged: noise must
not look like ground. Results are rounded identically on every processor (see `gradients`): means of integer grey levels
are exact, and products and sums are computed one by one."""

import math

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Mask, Singles
from edgevpr.techniques.gradients import round_levels

_BLOCKS_PER_SIDE = 64  # the contrast is measured on means of blocks, which have little noise
_CLIPPED_FRACTION = 0.01  # of the blocks, at the dark and at the bright end
# Minimum contrast of ground, in grey levels. If blocks have few pixels, the noise of 3 levels raises this minimum.
_MIN_CONTRAST_LEVELS = 4.0
_NOISE_LEVELS = 3 * 4.65  # 3 levels, from the 1st to the 99th percentile of a normal distribution
_MAX_SIGMA_PIXELS = 1.4
_SMOOTHING_ROUNDS = 4  # fewer rounds cannot reach `_MAX_SIGMA_PIXELS`


def stretch_contrast(
    grey: Singles,
    allowed: Mask | None,
    pixel_px: tuple[float, float],
    min_levels: float,
    target_levels: float,
    sigma_pixels: float,
) -> Singles:
    """Return a square picture, stretched if its contrast is below `min_levels`. A contrast of at most half of that
    becomes `target_levels`, which is at most four times `min_levels`. Each doubling of the contrast blurs the picture
    by `sigma_pixels`, in pixels of the original picture.

    Contrast is the range of the mean grey levels of small blocks, without the darkest and the brightest 1 %. Only
    blocks of `allowed` pixels, bool (side, side), are used (None: all). `grey` is float32 (side, side), 0 to 255; the
    same array is returned if its contrast is sufficient or too low. `pixel_px`: width and height of a pixel of the
    original picture, in pixels of the square."""
    low, high = _find_range(grey, allowed)
    range_levels = high - low
    noise_levels = _NOISE_LEVELS * math.sqrt(pixel_px[0] * pixel_px[1]) * _BLOCKS_PER_SIDE / len(grey)
    if not max(_MIN_CONTRAST_LEVELS, noise_levels) <= range_levels < min_levels:
        return grey
    ratio = min_levels / range_levels
    gain = min(ratio * ratio * ratio, target_levels / range_levels)  # starts at 1, without a jump
    # A bright on-screen display must not bleed into the ground next to it.
    picture = grey.copy() if allowed is None else np.where(allowed, grey, np.float32((low + high) / 2))
    sigma = min(_MAX_SIGMA_PIXELS, sigma_pixels * math.log2(gain))
    across, down = (min(max(1, round(pixels)), len(grey) // 4) for pixels in pixel_px)
    _smooth_rows(picture, sigma, across)
    _smooth_rows(picture.T, sigma, down)
    picture -= np.float32(low)
    picture *= np.float32(gain)
    picture += np.float32(min(low, 255 - target_levels))
    return np.asarray(np.clip(picture, 0, 255, out=picture))


def _find_range(grey: Singles, allowed: Mask | None) -> tuple[float, float]:
    """Return the ends of the range of grey levels (see `stretch_contrast`); (0, 0) if no block is allowed."""
    means = _average_blocks(round_levels(grey))
    if allowed is not None:
        means = means[_average_blocks(allowed.view(np.uint8)) > 0.999]
    if not means.size:
        return 0.0, 0.0
    clipped_count = int(_CLIPPED_FRACTION * means.size)
    ordered = np.sort(means, axis=None)
    return float(ordered[clipped_count]), float(ordered[-1 - clipped_count])


def _average_blocks(levels: Array) -> Array:
    """Average uint8 (side, side) over square blocks: float32 (n, n). Sums of integers are exact in any order."""
    block_px = max(1, len(levels) // _BLOCKS_PER_SIDE)
    n = len(levels) // block_px
    cropped = levels[: n * block_px, : n * block_px].astype(np.float32)
    return cv2.resize(cropped, (n, n), interpolation=cv2.INTER_AREA)


def _smooth_rows(grey: Array, sigma_pixels: float, pixel_px: int) -> None:
    """Smooth (H, W) in place along its rows, with a sigma of `sigma_pixels` pixels of `pixel_px` each. Each round
    averages every pixel with the two that are `pixel_px` away."""
    side_weight = np.float32(sigma_pixels * sigma_pixels / (2 * _SMOOTHING_ROUNDS))
    middle_weight = np.float32(1) - 2 * side_weight
    neighbours, step = np.empty_like(grey), pixel_px
    for _ in range(_SMOOTHING_ROUNDS):
        np.add(grey[:, : -2 * step], grey[:, 2 * step :], out=neighbours[:, step:-step])
        np.add(grey[:, :1], grey[:, step : 2 * step], out=neighbours[:, :step])
        np.add(grey[:, -2 * step : -step], grey[:, -1:], out=neighbours[:, -step:])
        neighbours *= side_weight
        grey *= middle_weight
        grey += neighbours
