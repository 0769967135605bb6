"""The recording of a flight, from which `review` can replay it: a folder with `tape.jsonl`, one line per input, and
`frames/`, the pictures as JPEG.

A separate thread writes, so a slow disk does not delay queries. A recording with a gap cannot be replayed: if the disk
is too slow or full, or the recording too large, it ends and the flight continues.
"""

import errno
import json
import logging
import os
import re
import shutil
import threading
from base64 import b64encode
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, TypeVar

from edgevpr.core.appending import append_bytes, open_appending, sync_file
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.text import redact_passwords
from edgevpr.runtime.flight.boundary import Tape
from edgevpr.runtime.flight.flightlog import Line, select_last_flight

TAPE = "tape.jsonl"
FRAMES = "frames"
MIN_FREE_BYTES = 100_000_000  # to leave free on the disk for logs and map
MAX_QUEUED_BYTES = 32_000_000  # limit of queued pictures while the disk is slow: minutes of a small camera
MAX_QUEUED_NOTES = 100_000
_WRITE_INTERVAL_S = 0.5  # a power cut loses the input since the last write
_CLOSE_TIMEOUT_S = 1.5  # longest wait for the thread: the end of a flight takes two seconds at most
_FOLDER_PATTERN = re.compile(r"flight-(\d{4,})")

T = TypeVar("T")
_log = logging.getLogger(__name__)


class Recording(Tape, AbstractContextManager["Recording"]):
    """An open recording (a context manager) in the folder `path`: the `Tape` of all input, and frames. `state` is None
    while recording, then a sentence with the reason for its end."""

    def __init__(self, folder: str | Path, max_mb: float) -> None:
        """Create a folder for this flight in `folder`. Earlier recordings there may use half of `max_mb`, the oldest
        are deleted; the new one may use the other half. Raises EdgevprError."""
        self.state: str | None = None
        self._max_bytes = 1e6 * max_mb / 2
        self._queue: deque[bytes | tuple[int, bytes]] = deque()  # a note, or a frame with its number
        self._bytes_queued = self._bytes_written = 0  # of frames
        self._frames = 0
        self._closing = threading.Event()
        try:
            Path(folder).mkdir(mode=0o750, exist_ok=True)
            last = max((int(path.name.rpartition("-")[2]) for path in list_recordings(Path(folder))), default=0)
            self.path = Path(folder) / f"flight-{last + 1:04d}"
            self.path.mkdir(mode=0o750)
            (self.path / FRAMES).mkdir(mode=0o750)
            self._tape = open_appending(self.path / TAPE)
        except OSError as error:
            raise EdgevprError(
                f"Cannot record in {folder} ({error.strerror}): set `log.record` to a writable folder, or remove it."
            ) from error
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    def read(self, kind: str, measure: Callable[[], T]) -> T:
        """Return the result of `measure`, and record it on the tape under `kind`."""
        value = measure()
        self.note(kind, value)
        return value

    def note(self, kind: str, *values: Any) -> None:
        """Record an input on the tape. May be called from any thread and from a signal handler; never blocks."""
        if self.state is None:
            line = json.dumps([kind, *values], default=lambda data: b64encode(data).decode())
            self._queue.append(redact_passwords(line).encode() + b"\n")

    def store_frame(self, jpeg: bytes) -> int:
        """Record a picture, and return its number in this recording (1, 2, ...), for `frame_path`."""
        self._frames += 1
        if self.state is None:
            self._bytes_queued += len(jpeg)
            self._queue.append((self._frames, jpeg))
        return self._frames

    def __exit__(self, *_: object) -> None:
        """Write the queue and close the tape. Gives up after 1.5 seconds, with a warning."""
        self._closing.set()
        self._thread.join(_CLOSE_TIMEOUT_S)
        if self._thread.is_alive():
            _log.warning("The end of the recording %s is missing: the disk is too slow.", self.path)

    # The methods below run in the recording's own thread.

    def _run(self) -> None:
        try:
            self._delete_oldest()
            while not self._closing.wait(_WRITE_INTERVAL_S):
                self._write()
            self._write()
        except OSError as error:
            self.state = (
                f"The recording {self.path} has ended ({error.strerror}). It can be replayed up to here; the flight "
                "continues."
            )
            _log.warning("%s", self.state)
        finally:
            self._queue.clear()
            with suppress(OSError):
                self._tape.close()

    def _write(self) -> None:
        """Write the queue, frames before the lines that refer to them. Raises OSError if the recording must end."""
        if self._bytes_queued - self._bytes_written > MAX_QUEUED_BYTES or len(self._queue) > MAX_QUEUED_NOTES:
            raise OSError(errno.EIO, "the disk is too slow")
        notes = []
        for _ in range(len(self._queue)):
            item = self._queue.popleft()
            if isinstance(item, bytes):
                notes.append(item)
            else:
                number, jpeg = item
                with open_appending(frame_path(self.path, number)) as file:
                    append_bytes(file, jpeg)
                    sync_file(file)
                self._bytes_written += len(jpeg)
        if not notes:
            return
        disk = os.fstatvfs(self._tape.fileno())
        if disk.f_bavail * disk.f_frsize < MIN_FREE_BYTES:
            raise OSError(errno.ENOSPC, f"less than {MIN_FREE_BYTES // 1_000_000} MB free on the disk")
        if self._bytes_written + os.fstat(self._tape.fileno()).st_size > self._max_bytes:
            raise OSError(errno.EFBIG, "it has reached its limit, half of log.record_mb")
        append_bytes(self._tape, b"".join(notes))
        sync_file(self._tape)

    def _delete_oldest(self) -> None:
        *earlier, _ = list_recordings(self.path.parent)
        sizes = {path: sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) for path in earlier}
        for folder in earlier:
            if sum(sizes.values()) <= self._max_bytes:
                return
            shutil.rmtree(folder)
            del sizes[folder]
            _log.info("deleted the recording %s to free space for this flight", folder)


def frame_path(folder: Path, number: int) -> Path:
    """Return the path of picture `number` in the folder of a recording."""
    return folder / FRAMES / f"{number:06d}.jpg"


def find_recording(folder_name: str | None, log: str | Path) -> Path | None:
    """Return the folder of the recording `folder_name` of a `log` (None: not recorded): at that path, or in a folder
    with that name next to the log; None if it is at neither."""
    if not folder_name:
        return None
    path = Path(folder_name)
    next_to_log = Path(log).resolve().parent / path.parent.name / path.name
    return next((folder for folder in (path, next_to_log) if (folder / TAPE).is_file()), None)


def read_recorded(log: str | Path) -> tuple[list[Line], Path]:
    """Return the lines of the last flight of `log`, and the folder of its recording (see `find_recording`). Raises
    UsageError if there is none, and EdgevprError if the file contains no flight."""
    flight = select_last_flight(log)
    if flight.missing:
        _log.warning("%s", flight.missing)
    lines = list(flight)
    folder_name = lines[0].get("recording") if lines else None
    if not folder_name:
        raise UsageError(f"The last flight of {log} was not recorded: set `log: {{record: FOLDER}}` before the flight.")
    folder = find_recording(folder_name, log)
    if folder is None:
        raise UsageError(f"The recording of {log} is neither at {folder_name} nor next to the log: copy it to either.")
    return lines, folder


def list_frames(folder: Path) -> dict[str, Path]:
    """Return the picture files of the recording in `folder`, by the frames' names in the flight log."""
    paths = {}
    with open(folder / TAPE, "rb") as tape:
        for line in tape:
            with suppress(ValueError, LookupError, TypeError):  # a truncated line, or no frame
                if line.startswith(b'["frame", {'):
                    frame = json.loads(line)[1]
                    paths[frame["name"]] = frame_path(folder, frame["number"])
    return paths


def has_live_source(folder: Path) -> bool:
    """Return True if the pictures of the recording in `folder` are from a live camera or stream."""
    with open(folder / TAPE, "rb") as tape:
        return any(line.startswith(b'["is_live", true') for line in tape)


def list_recordings(folder: Path) -> list[Path]:
    """List the folders of the recordings in `folder`, oldest first."""
    numbered = [(int(match[1]), path) for path in folder.iterdir() if (match := _FOLDER_PATTERN.fullmatch(path.name))]
    return [path for _, path in sorted(numbered)]
