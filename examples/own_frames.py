"""Frames from a source of your own: python own_frames.py MAP FOLDER

`frames` stands for what gives you pictures: a camera of another library, a simulator, a robot. With `follow`, one
picture helps the next: they are taken as those of one flight.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

import edgevpr


def frames(folder: str) -> Iterator[tuple[float, np.ndarray]]:
    """Yield the time, in seconds, and the picture, uint8 (H, W, 3) blue, green, red."""
    for number, path in enumerate(sorted(Path(folder).glob("*.jpg"))):
        yield float(number), cv2.imread(str(path))


def main(path: str, folder: str) -> None:
    with edgevpr.Map(path, follow=True) as ground:
        for t_s, picture in frames(folder):
            match = ground.match(picture, t_s=t_s)
            sure = "" if match.confidence is None else f", {match.confidence:.6f} sure"
            print(f"{t_s:6.1f} s  {'yes' if match.accepted else 'no '}  {1000 * match.t_query_s:.0f} ms{sure}")


if __name__ == "__main__":
    main(*sys.argv[1:])
