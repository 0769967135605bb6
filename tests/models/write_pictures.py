"""Folders of made pictures to train on."""

from pathlib import Path

import cv2
import numpy as np


def write_pictures(folder: Path, count: int, seed: int = 0) -> Path:
    """`count` JPEGs of 160x120: stripes at an angle of their own, which is soon learnt, under spots of their own."""
    folder.mkdir()
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:120, :160]
    for number in range(count):
        angle = np.pi * number / count
        picture = 128 + 60 * np.sin((x * np.cos(angle) + y * np.sin(angle)) / 3)
        spots = rng.normal(0, 25, (12, 16)).astype(np.float32)
        picture += cv2.resize(spots, (160, 120), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{number}.jpg"), np.clip(picture, 0, 255).astype(np.uint8))
    return folder
