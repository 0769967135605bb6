"""encode_ram.py TECHNIQUE SETTINGS: MB that a technique adds to a process with NumPy and OpenCV, until it has encoded a
picture of 640x480."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

from edgevpr import techniques


def peak_mb() -> float:
    """The most that was resident so far."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024 / 1e6


def main() -> None:
    name, chosen = sys.argv[1], json.loads(sys.argv[2])
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8), (0, 0), 3)
    before_mb = peak_mb()
    techniques.create(name, chosen).encode(picture)
    print(f"{peak_mb() - before_mb:.1f}")


if __name__ == "__main__":
    main()
