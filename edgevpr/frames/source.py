"""Where frames come from: a folder of images, a video file, a camera or a network stream, all read alike."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from edgevpr.config import SOURCES
from edgevpr.errors import SourceError, UsageError
from edgevpr.frames.condition import Condition
from edgevpr.frames.images import EXTENSIONS
from edgevpr.frames.live import LiveSource, open_camera, open_stream
from edgevpr.frames.recordings import FolderSource, VideoSource
from edgevpr.types import Frame

_SCHEMES = ("rtsp", "rtsps", "udp", "tcp", "http", "https")
_SCHEMES_THAT_NEED_A_PORT = ("udp", "tcp")


class Source(Protocol):
    """A source of frames.

    `is_live`: its pictures are of now, and the newest counts; a recording is read in order to its end. `ended`: no
    frame will come any more. `total`: about how many there will be, 0 where nobody can know. `dropped`: how many
    pictures nobody took in time, None of a recording, which drops none. `condition`, and as `state` in a few words for
    people ("reading", "streaming", "lost, reopening in 2 s")."""

    is_live: bool

    @property
    def ended(self) -> bool: ...

    @property
    def total(self) -> int: ...

    @property
    def dropped(self) -> int | None: ...

    @property
    def condition(self) -> Condition: ...

    @property
    def state(self) -> str: ...

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame (of a live source the newest), or None where there is none within `timeout_s`.

        Raises ImageError for an image that cannot be used; the call after it goes on with the next one.
        """
        ...

    def close(self) -> None:
        """Let go of the file, the device or the connection."""
        ...


def open_source(
    uri: str,
    *,
    step_s: float | None = None,
    positions: Path | None = None,
    live: bool,
    clock: Callable[[], float] = time.monotonic,
) -> Source:
    """Open what `uri` names; `live` says whether cameras and streams, which never end, are welcome.

    `step_s` is the least video time between two frames of a video file. `positions` is the positions.csv of a folder
    of images; without it, the one that lies there counts, else EXIF. A stream that is not there yet is waited for.
    Raises SourceError for what is not understood or not there, UsageError for positions that make no sense.
    """
    path = Path(uri)
    if positions and not path.is_dir():
        raise UsageError(f"{positions} can only place the images of a folder, and {uri} is none: leave it out.")
    if path.is_dir():
        return FolderSource(path, positions, clock)
    if is_live(uri):
        if not live:
            raise SourceError(f"{uri} is live and never ends: give a folder of images or a video file here.")
        return LiveSource(_capture_of(uri), clock)
    if not path.is_file():
        raise SourceError(f"There is nothing at `{uri}`: give {SOURCES}.")
    if path.name.lower().endswith(EXTENSIONS):
        raise SourceError(f"{uri} is a single image: give the folder that holds it.")
    return VideoSource(path, step_s or 0.0, clock)


def is_live(uri: str) -> bool:
    """Say whether `uri` names a camera or a stream; all else is a recording."""
    is_device = uri.startswith("/dev/") and not Path(uri).is_file()  # /dev/shm holds plain files
    return "://" in uri or is_device or uri.lower().endswith(".sdp")


def _capture_of(uri: str) -> Callable[[], Any]:
    """What opens the camera or stream; raises SourceError for one that can never be opened."""
    if "://" in uri:
        _check_address(uri)
    elif not Path(uri).exists():
        raise SourceError(f"There is nothing at `{uri}`: connect the camera or correct the name.")
    elif not os.access(uri, os.R_OK):
        raise SourceError(
            f"{uri} may not be read by this user: add the user to the group that owns it (often `video`)."
        )
    elif uri.startswith("/dev/"):
        return lambda: open_camera(uri)
    else:
        # FFmpeg connects to what an .sdp file names only when told that it may, and OpenCV hands on what it is told
        # in the environment only.
        os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist;file,rtp,udp")
    return lambda: open_stream(uri)


def _check_address(uri: str) -> None:
    try:
        address = urlsplit(uri)
        host, port = address.hostname, address.port
    except ValueError as error:
        raise SourceError(f"{uri} is not a proper address ({error}): write it like rtsp://HOST:PORT/PATH.") from None
    if address.scheme not in _SCHEMES:
        raise SourceError(f"{uri}: {address.scheme}:// is not understood: give {SOURCES}.")
    if port is None and address.scheme in _SCHEMES_THAT_NEED_A_PORT:
        raise SourceError(f"{uri} names no port: write it like {address.scheme}://HOST:PORT.")
    if host is None and address.scheme != "udp":  # udp://:PORT listens on all interfaces
        raise SourceError(f"{uri} names no host: write it like {address.scheme}://HOST:PORT.")
