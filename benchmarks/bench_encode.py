"""Encoding one frame: edgevpr's `cohog`, the published way (competitor.py), and the least that any HOG has to do.

The three take turns on the same frames, 640x480 grey, on one thread, so that whatever else the machine does hits all of
them; ratios are taken turn by turn. The floor is the resize to 512x512 and two 3x3 Sobel passes into float32. Frames
come from the generated scene and, where they are at hand, from image sets (../shared/data or $EDGEVPR_DATA).
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import competitor
import cv2
import numpy as np

from edgevpr.lab.simulate.scene import make_scene
from edgevpr.techniques import create

DATA = Path(os.environ.get("EDGEVPR_DATA") or Path(__file__).resolve().parents[2] / "shared/data")
FRAME = 640, 480  # width, height
SIDE_PX = 512
FRAMES_A_SET = 2


@dataclass(frozen=True, slots=True)
class EncodeRow:
    """One line of the table: medians over all turns; `ratio` is the competitor's time over ours."""

    entropy: str
    ours_ms: float
    competitor_ms: float
    ratio: float
    floor_ms: float
    times_floor: float
    worst_difference: float  # of a descriptor value from the competitor's
    good_differing: int  # blocks, over all frames, whose goodness is not the competitor's


def frames() -> list[np.ndarray]:
    """Generated frames and real ones, uint8 (480, 640)."""
    ground = cv2.cvtColor(make_scene(seed=3, width_m=220, depth_m=170).albedo, cv2.COLOR_BGR2GRAY)
    found = [ground[top : top + FRAME[1], left : left + FRAME[0]] for top, left in ((100, 100), (500, 600))]
    for folder in sorted(DATA.glob("*/query")):
        paths = sorted(folder.iterdir())
        images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths[:: -(-len(paths) // FRAMES_A_SET)]]
        large_enough = [image for image in images if image is not None and min(image.shape) >= 100]
        found += [cv2.resize(image, FRAME, interpolation=cv2.INTER_AREA) for image in large_enough]
    return found


def measure(entropy: str, pictures: list[np.ndarray], turns: int) -> EncodeRow:
    """Time one entropy definition on every picture, `turns` times each."""
    technique = create("cohog", {"entropy": entropy})
    times_s = []
    worst, differing = 0.0, 0
    for picture in pictures:
        ours, theirs = technique.encode(picture), published(picture, entropy)
        worst = max(worst, float(np.abs(ours.regions - theirs[0]).max()))
        differing += int((ours.good != theirs[1]).sum())
        for _ in range(turns):
            turn = technique.encode, lambda image: published(image, entropy), floor
            times_s.append([timed_s(function, picture) for function in turn])
    ours_s, theirs_s, floor_s = np.array(times_s).T
    ours_ms, competitor_ms, floor_ms = (1000 * float(np.median(s)) for s in (ours_s, theirs_s, floor_s))
    ratio, times_floor = float(np.median(theirs_s / ours_s)), float(np.median(ours_s / floor_s))
    return EncodeRow(entropy, ours_ms, competitor_ms, ratio, floor_ms, times_floor, worst, differing)


def published(picture: np.ndarray, entropy: str) -> tuple[np.ndarray, np.ndarray]:
    scaled = cv2.resize(picture.astype(np.float32), (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_LINEAR)
    return competitor.encode(scaled, entropy)


def floor(picture: np.ndarray) -> None:
    grey = cv2.resize(picture, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_LINEAR)
    cv2.Sobel(grey, cv2.CV_32F, 1, 0)
    cv2.Sobel(grey, cv2.CV_32F, 0, 1)


def timed_s(function: Callable[[np.ndarray], object], picture: np.ndarray) -> float:
    """Wall time of a call right after another: the first pays for the caches and the memory that the others left."""
    function(picture)
    start = time.perf_counter()
    function(picture)
    return time.perf_counter() - start


def rows(turns: int = 10) -> list[EncodeRow]:
    """Both entropy definitions, on one thread of OpenCV."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        pictures = frames()
        return [measure(entropy, pictures, turns) for entropy in ("shannon", "filled_bins")]
    finally:
        cv2.setNumThreads(threads)


def table(results: list[EncodeRow]) -> str:
    """The results as a Markdown table."""
    lines = [
        "| encode `cohog` | edgevpr ms | published way ms | ratio | floor ms | times the floor | largest difference "
        "of a descriptor value | good regions that differ |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in results:
        lines.append(
            f"| {row.entropy} | {row.ours_ms:.2f} | {row.competitor_ms:.1f} | {row.ratio:.1f} | {row.floor_ms:.2f} "
            f"| {row.times_floor:.1f} | {row.worst_difference:.1e} | {row.good_differing} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(rows(int(sys.argv[1]) if len(sys.argv) > 1 else 10)))
