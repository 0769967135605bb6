"""Cameras that a program of the system reads for us. `rpicam`, or `rpicam:1` for the second one, is a Raspberry Pi's on
the ribbon cable, read by rpicam-vid; `gst: PIPELINE` is whatever GStreamer can read, by gst-launch-1.0.

The program sends pictures (MJPEG) over loopback, and they are read as any stream is, with its time-outs. So the flight
loads no library of cameras, and one that hangs does not stop it. The program ends when its reader has gone.
"""

import logging
import re
import shlex
import shutil
import socket
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress

from edgevpr.core.errors import SourceError
from edgevpr.frames.shot import OpeningError, Refusal, Shot
from edgevpr.frames.streams import StreamCapture, open_stream

_RIBBON, _PIPELINE = "rpicam-vid", "gst-launch-1.0"
_OLDER = {_RIBBON: "libcamera-vid"}  # names on older systems
_PACKAGES = {
    _RIBBON: "rpicam-apps-lite",
    _PIPELINE: "gstreamer1.0-tools gstreamer1.0-plugins-base gstreamer1.0-plugins-good",
}
# For this size the usual sensors (OV5647, IMX219, IMX477, IMX708) read all of their pixels, binned: for a smaller one
# some read the middle only, and see less.
_SIZE_PX, _RATE_HZ, _QUALITY = (1280, 960), 10, 90
_APPSINK = re.compile(r"!\s*appsink\b[^!]*$")  # as pipelines for OpenCV end
_WAITING_PICTURES = 10  # of a reader that does not read: older ones are dropped
_STARTS_S, _LOOK_S, _ENDS_S = 8.0, 0.1, 2.0  # a camera takes a second or two to start
_log = logging.getLogger(__name__)


def require_program(uri: str) -> str:
    """Return the path of the system's program that reads this camera. Raises SourceError if it is not installed, or if
    `uri` is no pipeline."""
    name = _RIBBON
    if uri.startswith("gst:"):
        name = _PIPELINE
        _words(uri)
    found = shutil.which(name) or shutil.which(_OLDER.get(name, name))
    if found is None:
        packages = _PACKAGES[name]
        raise SourceError(f"{name}, which reads this camera, is not here: run `sudo apt install {packages}`.")
    return found


def open_by_program(uri: str, clock: Callable[[], float]) -> "ProgramCapture | None":
    """Start the program for the camera `uri`, and connect to it; None if it gives no picture. `clock` is the monotonic
    clock, in seconds."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    is_pipeline = uri.startswith("gst:")
    process = subprocess.Popen(
        (_pipeline if is_pipeline else _ribbon)(uri, port),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    end_s = time.monotonic() + _STARTS_S
    while process.poll() is None and time.monotonic() < end_s:
        with suppress(OpeningError):
            return ProgramCapture(open_stream(f"tcp://127.0.0.1:{port}", clock, "mjpeg"), process)
        time.sleep(_LOOK_S)
    why = (
        f"run `{_PIPELINE} -v` with it to see why, and end it with raw video (video/x-raw)"
        if is_pipeline
        else "`rpicam-hello --list-cameras` says if it is found, and whether it is in use"
    )
    _log.warning("%s gives no picture: %s", uri, why)
    _end(process)
    return None


class ProgramCapture:
    """The pictures of a camera that `process` reads and sends: a `Capture`."""

    def __init__(self, stream: StreamCapture, process: "subprocess.Popen[bytes]") -> None:
        self._stream, self._process = stream, process

    def read(self) -> Shot | Refusal | None:
        return self._stream.read()

    def release(self) -> None:
        _end(self._process)  # first: a stream without a sender ends at once
        self._stream.release()


def _ribbon(uri: str, port: int) -> list[str]:
    """Return the command that sends the pictures of a ribbon camera to the first who connects to `port`."""
    return [
        *(require_program(uri), "--camera", uri.partition(":")[2] or "0", "--timeout", "0", "--nopreview"),
        *("--verbose", "0", "--codec", "mjpeg", "--quality", str(_QUALITY), "--framerate", str(_RATE_HZ)),
        *("--width", str(_SIZE_PX[0]), "--height", str(_SIZE_PX[1])),
        *("--listen", "--output", f"tcp://127.0.0.1:{port}"),
    ]


def _pipeline(uri: str, port: int) -> list[str]:
    """Return the command that sends the pictures of a pipeline to those who connect to `port`. It does not notice that
    they have gone, so setpriv has it ended with us."""
    sink = f"sync=false buffers-soft-max={_WAITING_PICTURES} recover-policy=latest host=127.0.0.1 port={port}"
    sent = f"! videoconvert ! jpegenc quality={_QUALITY} ! tcpserversink {sink}"
    return ["setpriv", "--pdeathsig", "TERM", require_program(uri), "-q", *_words(uri), *sent.split()]


def _words(uri: str) -> list[str]:
    """Split a pipeline, without an appsink, into words. Raises SourceError if there is none or a quote does not end."""
    try:
        words = shlex.split(_APPSINK.sub("", uri.removeprefix("gst:")))
    except ValueError:
        words = []
    if not words:
        raise SourceError(
            f"`{uri}` is no pipeline: write one as for gst-launch-1.0 after `gst:`, with quotes that end."
        )
    return words


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(_ENDS_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
