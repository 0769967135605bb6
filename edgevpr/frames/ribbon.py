"""Cameras of a Raspberry Pi on the ribbon cable: `rpicam`, or `rpicam:1` for the second one.

The system's `rpicam-vid` sends pictures (MJPEG) over loopback, and they are read as any stream is, with its time-outs.
So the flight loads no library of cameras, and one that hangs does not stop it. `rpicam-vid` ends when its reader has
gone.
"""

import logging
import shutil
import socket
import subprocess
import time
from collections.abc import Callable

from edgevpr.core.errors import SourceError
from edgevpr.frames.shot import Refusal, Shot
from edgevpr.frames.streams import StreamCapture, open_stream

_PROGRAMS = ("rpicam-vid", "libcamera-vid")  # the second on older systems
# For this size the usual sensors (OV5647, IMX219, IMX477, IMX708) read all of their pixels, binned: for a smaller one
# some read the middle only, and see less.
_SIZE_PX, _RATE_HZ, _QUALITY = (1280, 960), 10, 90
_STARTS_S, _LOOK_S, _ENDS_S = 8.0, 0.1, 2.0  # a camera takes a second or two to start
_log = logging.getLogger(__name__)


def require_program() -> str:
    """Return the path of the system's program for these cameras. Raises SourceError if it is not installed."""
    found = next(filter(None, map(shutil.which, _PROGRAMS)), None)
    if found is None:
        raise SourceError("rpicam-vid, which reads this camera, is not here: run `sudo apt install rpicam-apps-lite`.")
    return found


def open_ribbon(uri: str, clock: Callable[[], float]) -> "RibbonCapture | None":
    """Start the camera, and connect to it; None if it does not start. `clock` is the monotonic clock, in seconds."""
    number = uri.partition(":")[2] or "0"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    process = subprocess.Popen(
        [
            *(require_program(), "--camera", number, "--timeout", "0", "--nopreview", "--verbose", "0"),
            *("--codec", "mjpeg", "--quality", str(_QUALITY), "--framerate", str(_RATE_HZ)),
            *("--width", str(_SIZE_PX[0]), "--height", str(_SIZE_PX[1]), "--listen", "--output", address),
        ],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    end_s = time.monotonic() + _STARTS_S
    while process.poll() is None and time.monotonic() < end_s:
        if stream := open_stream(address, clock, "mjpeg"):
            return RibbonCapture(stream, process)
        time.sleep(_LOOK_S)
    _log.warning(
        "%s gives no picture: `rpicam-hello --list-cameras` says if it is found, and whether it is in use", uri
    )
    _end(process)
    return None


class RibbonCapture:
    """The pictures of a camera that `process` reads and sends: a `Capture`."""

    def __init__(self, stream: StreamCapture, process: "subprocess.Popen[bytes]") -> None:
        self._stream, self._process = stream, process

    def read(self) -> Shot | Refusal | None:
        return self._stream.read()

    def release(self) -> None:
        _end(self._process)  # first: a stream without a sender ends at once
        self._stream.release()


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(_ENDS_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
