"""Films as cameras write them, made for a test, and harm done to them."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

FRAMES, RATE_HZ = 75, 25


def film(path: Path, *coding: str) -> Path:
    """Film three seconds of a test picture at 25 Hz, with a key frame every second."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the video is made with ffmpeg (pip install imageio-ffmpeg)")
    picture = ["-f", "lavfi", "-i", f"testsrc2=size=320x240:rate={RATE_HZ}:duration={FRAMES // RATE_HZ}"]
    subprocess.run([ffmpeg.get_ffmpeg_exe(), "-v", "quiet", *picture, "-g", "25", *coding, str(path)], check=True)
    return path


def overwrite_in_the_middle(path: Path, count: int = 300) -> None:
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + count] = np.random.default_rng(1).bytes(count)
    path.write_bytes(data)


def cut_in_half(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
