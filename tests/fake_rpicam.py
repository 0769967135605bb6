"""Stands for rpicam-vid in tests: takes the flags that it documents and no others, waits for one reader on the address
of --output, and sends it MJPEG until the reader goes or it is told to end.

With --list-cameras it lists one. FAKE_RPICAM in the environment: `absent` ends at once as without a camera, or lists
none; `hangs` sends a few pictures and then none; `slow` takes seconds to the first."""

import argparse
import os
import socket
import sys
import time
from pathlib import Path

import cv2
import numpy as np

FLAGS = ("camera", "timeout", "codec", "quality", "framerate", "width", "height", "output", "verbose")
HANGS_AFTER = 8
SLOW_S = 2.0  # longer than a test lets streams take to open


LISTED = (
    "Available cameras\n-----------------\n0 : imx219 [3280x2464 10-bit RGGB] (/base/soc/i2c0mux/i2c@1/imx219@10)\n"
)


def install(folder: Path) -> str:
    """Write a program of the name of the real one into a folder; return a PATH that begins with the folder."""
    program = folder / "rpicam-vid"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} {__file__} "$@"\n')
    program.chmod(0o755)
    return f"{folder}{os.pathsep}{os.environ['PATH']}"


def main() -> None:
    if sys.argv[1:] == ["--list-cameras"]:
        print("No cameras available!" if os.environ.get("FAKE_RPICAM") == "absent" else LISTED)
        return
    parser = argparse.ArgumentParser(allow_abbrev=False)
    for flag in FLAGS:
        parser.add_argument(f"--{flag}", required=True)
    for flag in ("nopreview", "listen"):
        parser.add_argument(f"--{flag}", action="store_true", required=True)
    given = parser.parse_args()
    how = os.environ.get("FAKE_RPICAM", "")
    assert (given.codec, given.timeout) == ("mjpeg", "0")
    if how == "absent" or given.camera != "0":
        sys.exit("ERROR: *** no cameras available ***")
    host, _, port = given.output.removeprefix("tcp://").rpartition(":")
    with socket.create_server((host, int(port))) as listener:
        reader, _ = listener.accept()
    if how == "slow":
        time.sleep(SLOW_S)
    rng = np.random.default_rng(0)
    for number in range(10**9):
        if how == "hangs" and number == HANGS_AFTER:
            time.sleep(3600)
        picture = rng.integers(0, 256, (int(given.height) // 8, int(given.width) // 8, 3), np.uint8)
        picture = cv2.resize(picture, (int(given.width), int(given.height)), interpolation=cv2.INTER_CUBIC)
        picture[:40, :40] = number % 256
        try:
            reader.sendall(cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, int(given.quality)))[1].tobytes())
        except OSError:
            return
        time.sleep(1 / float(given.framerate))


if __name__ == "__main__":
    main()
