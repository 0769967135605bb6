"""Cameras that a system program reads. `rpicam`, or `rpicam:1` for the second one, is a Raspberry Pi's ribbon-cable
camera, read with rpicam-vid; `gst: PIPELINE` is anything that GStreamer can read, with gst-launch-1.0.

The program sends MJPEG over loopback, which is read like any stream, with the same timeouts. So the flight loads no
camera library, and a camera that hangs does not stop it. The program is killed when the thread that started it ends
(setpriv), for whatever reason: a leftover program would block the camera."""

import logging
import re
import shlex
import shutil
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from edgevpr.core.errors import SourceError
from edgevpr.core.text import sanitize
from edgevpr.core.types import FRAME_TIME_SD_S
from edgevpr.frames.age import HIDDEN_DELAY_SD_S
from edgevpr.frames.shot import Capture, OpeningError, Refusal, Shot
from edgevpr.frames.streams import StreamCapture, open_raw

_RPICAM = "rpicam-vid"
_GSTREAMER = "gst-launch-1.0"
_PACKAGES = {
    _RPICAM: "rpicam-apps-lite",
    _GSTREAMER: "gstreamer1.0-tools gstreamer1.0-plugins-base gstreamer1.0-plugins-good",
}
_ADVICE = {
    _RPICAM: "run `rpicam-hello --list-cameras` to see whether the camera is detected and in use",
    _GSTREAMER: "run `gst-launch-1.0 -v` with the pipeline to see why, and end it with raw video (video/x-raw)",
}
# At this size the usual sensors (OV5647, IMX219, IMX477, IMX708) read out all pixels, binned. At a smaller size some
# crop to the middle and see less.
_SIZE_PX = (1280, 960)
_RATE_HZ = 10
_QUALITY = 90
_APPSINK_PATTERN = re.compile(r"!\s*appsink\b[^!]*$")  # ends pipelines written for OpenCV
_MAX_QUEUED_PICTURES = 10  # if the reader is slower, the oldest are dropped
# From the start to the first picture. A camera needs a second or two; GStreamer's plugin scan, or a sensor that several
# drivers share, needs 10 s or more on a small board. A program stopped too early is just as slow the next time.
_FIRST_PICTURE_TIMEOUT_S = 60.0
_POLL_PERIOD_S = 0.2
_TERMINATE_TIMEOUT_S = 2.0
_STDERR_LINES = 20  # number of last lines that are kept
_STDERR_CHARS = 160  # a longer line does not help in a status
_log = logging.getLogger(__name__)


def require_program(uri: str) -> str:
    """Return the path of the system program that reads this camera. Raises SourceError if there is none."""
    name = _choose_program(uri)
    if name == _GSTREAMER:
        _split_pipeline(uri)
    path = shutil.which(name)
    if path is None:
        raise SourceError(
            f"{name}, which is needed to read this camera, is not installed: run `sudo apt install {_PACKAGES[name]}`."
        )
    return path


def open_program(uri: str, clock: Callable[[], float]) -> "ProgramCapture":
    """Start the program for the camera `uri`, connect to it, and wait at most a minute for its first picture while it
    runs. `clock` is the monotonic clock, in seconds. Raises OpeningError if no picture arrives."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    name = _choose_program(uri)
    process = subprocess.Popen(
        _make_gstreamer_command(uri, port) if name == _GSTREAMER else _make_rpicam_command(uri, port),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    errors = ErrorLines(process)
    end_s = time.monotonic() + _FIRST_PICTURE_TIMEOUT_S
    while process.poll() is None and (left_s := end_s - time.monotonic()) > 0:
        with suppress(OpeningError):
            # A pipeline may read a stream, which has a hidden delay.
            delay_sd_s = HIDDEN_DELAY_SD_S if uri.startswith("gst:") else FRAME_TIME_SD_S
            stream = open_raw(f"tcp://127.0.0.1:{port}", clock, "mjpeg", left_s, delay_sd_s)
            if time.monotonic() < end_s:
                return ProgramCapture(stream, process)
            stream.release()  # FFmpeg reports a stream as open after its timeout, even without a picture
        time.sleep(_POLL_PERIOD_S)
    exit_code = process.poll()
    _log.warning("%s delivers no picture: %s", uri, _ADVICE[name])
    _terminate(process)
    if exit_code is None:
        raise OpeningError(f"no picture from {name} in {_FIRST_PICTURE_TIMEOUT_S:g} s")
    raise OpeningError(f"{name} exited with code {exit_code}{errors.explain_exit()}")


class ProgramCapture(Capture):
    """The pictures that `process` reads from a camera and sends."""

    def __init__(self, stream: StreamCapture, process: "subprocess.Popen[bytes]") -> None:
        self._stream, self._process = stream, process

    def read(self) -> Shot | Refusal | None:
        return self._stream.read()

    def cancel(self) -> None:
        self._process.terminate()
        self._stream.cancel()

    def release(self) -> None:
        _terminate(self._process)  # before the stream, which then ends at once
        self._stream.release()


class ErrorLines:
    """The last lines that a program writes to stderr. A thread reads them: a program whose pipe is full hangs."""

    def __init__(self, process: "subprocess.Popen[bytes]") -> None:
        self._process = process
        self._lines: deque[bytes] = deque(maxlen=_STDERR_LINES)
        self._thread = threading.Thread(target=self._read, name="stderr", daemon=True)
        self._thread.start()

    def explain_exit(self) -> str:
        """Return ": " and the line that best explains why the program ended; "" if there is none."""
        self._thread.join(_POLL_PERIOD_S)
        lines = [line.decode(errors="replace").strip() for line in list(self._lines)]
        lines = [line for line in lines if 0 < len(line) <= _STDERR_CHARS]
        best = [line for line in lines if "error" in line.lower()][:1] or lines[-1:]
        return f": {sanitize(best[0])}" if best else ""

    def _read(self) -> None:
        assert self._process.stderr is not None
        with self._process.stderr as pipe:
            self._lines.extend(iter(lambda: pipe.readline(2 * _STDERR_CHARS), b""))


def _choose_program(uri: str) -> str:
    return _GSTREAMER if uri.startswith("gst:") else _RPICAM


def _make_rpicam_command(uri: str, port: int) -> list[str]:
    """Return the command that sends the pictures of a ribbon-cable camera to the first client at `port`."""
    return [
        *("setpriv", "--pdeathsig", "KILL"),  # sent when our thread ends; the program has nothing to close
        *(require_program(uri), "--camera", uri.partition(":")[2] or "0", "--timeout", "0", "--nopreview"),
        *("--verbose", "0", "--codec", "mjpeg", "--quality", str(_QUALITY), "--framerate", str(_RATE_HZ)),
        *("--width", str(_SIZE_PX[0]), "--height", str(_SIZE_PX[1])),
        *("--listen", "--output", f"tcp://127.0.0.1:{port}"),
    ]


def _make_gstreamer_command(uri: str, port: int) -> list[str]:
    """Return the command that sends the pictures of a pipeline to all clients at `port`, and waits for new ones."""
    sink = f"sync=false buffers-soft-max={_MAX_QUEUED_PICTURES} recover-policy=latest host=127.0.0.1 port={port}"
    encoder = f"! videoconvert ! jpegenc quality={_QUALITY} ! tcpserversink {sink}"
    guard = "setpriv", "--pdeathsig", "TERM"  # sent when our thread ends, so that the program closes its camera
    return [*guard, require_program(uri), "-q", *_split_pipeline(uri), *encoder.split()]


def _split_pipeline(uri: str) -> list[str]:
    """Split a pipeline into words and drop a final appsink. Raises SourceError if it is empty or a quote is open."""
    with suppress(ValueError):
        if words := shlex.split(_APPSINK_PATTERN.sub("", uri.removeprefix("gst:"))):
            return words
    raise SourceError(f"`{uri}` must be `gst:` and a pipeline in the syntax of gst-launch-1.0, with all quotes closed.")


def _terminate(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(_TERMINATE_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
