"""The recording of a flight: its tape and its frames, with which it can be flown again on the ground.

A folder for each flight: `tape.jsonl`, a line for everything that came in, and `frames/`, the pictures as JPEG. Where
the flight learns, `map.gpkg` is the map as it was at the start.

A thread of its own writes: a slow disk keeps nobody waiting. A recording with a hole in it is worth nothing from there
on. So it never leaves anything out: where the disk is too slow or full, or the recording too large, it ends, and the
flight goes on.
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
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from edgevpr.core.appending import append, open_appending, sync
from edgevpr.core.errors import EdgevprError
from edgevpr.core.text import without_passwords

TAPE, FRAMES, MAP = "tape.jsonl", "frames", "map.gpkg"
SPARED_BYTES = 100_000_000  # of the disk, which are left to logs and map
WAITING_BYTES = 32_000_000  # of pictures that a slow disk keeps waiting: minutes of a small camera
WAITING_NOTES = 100_000
_WRITE_S = 0.5  # a power cut costs what came since the last writing
_CLOSE_S = 1.5  # the end of a flight takes two seconds at most
_FOLDER = re.compile(r"flight-(\d{4,})")

T = TypeVar("T")
_log = logging.getLogger(__name__)


class Recording:
    """An open recording, and its tape. `path` is its folder. `state` says why it has ended, None while it goes on.
    Close it (it is a context manager)."""

    def __init__(self, folder: str | Path, max_mb: float) -> None:
        """Make the folder of this flight in `folder`. Of the recordings there the oldest are deleted, until half of
        `max_mb` is free; the new one may take that half. Raises EdgevprError where it cannot be made."""
        self.state: str | None = None
        self._most_bytes = 1e6 * max_mb / 2
        self._waiting: deque[bytes | tuple[int, bytes]] = deque()  # a note, or a frame with its number
        self._bytes_put = self._bytes_written = 0  # of frames
        self._frames = 0
        self._closing = threading.Event()
        try:
            Path(folder).mkdir(mode=0o750, exist_ok=True)
            self.path = _new_folder(Path(folder))
            (self.path / FRAMES).mkdir(mode=0o750)
            self._tape = open_appending(self.path / TAPE)
        except OSError as error:
            raise EdgevprError(
                f"No flight can be recorded in {folder} ({error.strerror}): give a folder that is there and may be "
                "written to, or leave `log.record` out."
            ) from error
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, kind: str, look: Callable[[], T]) -> T:
        """Return what `look` finds, and take note of it."""
        found = look()
        self.note(kind, found)
        return found

    def note(self, kind: str, *values: Any) -> None:
        """Take note of what has happened. May be called from any thread and from a handler of signals; it never
        blocks."""
        if self.state is None:
            self._waiting.append(without_passwords(json.dumps([kind, *values], default=_encoded)).encode() + b"\n")

    def keep(self, jpeg: bytes) -> int:
        """Keep a picture, and return its number."""
        self._frames += 1
        if self.state is None:
            self._bytes_put += len(jpeg)
            self._waiting.append((self._frames, jpeg))
        return self._frames

    def keep_map(self, path: Path) -> None:
        """Keep a copy of the map as it is before the flight. Raises EdgevprError."""
        try:
            shutil.copyfile(path, self.path / MAP)
        except OSError as error:
            raise EdgevprError(
                f"{path} cannot be copied into {self.path} ({error.strerror}): a flight that learns is recorded with "
                "its map; make room, or leave `log.record` out."
            ) from error

    def close(self) -> None:
        """Write what waits, for a second or so at most, and close the tape."""
        self._closing.set()
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            _log.warning("The end of the recording %s is missing: the disk is too slow.", self.path)

    # The methods below run in the recording's own thread.

    def _run(self) -> None:
        try:
            self._delete_oldest()
            while not self._closing.wait(_WRITE_S):
                self._write()
            self._write()
        except OSError as error:
            self.state = (
                f"The recording {self.path} has ended ({error.strerror}): what there is can be replayed, and the "
                "flight goes on."
            )
            _log.warning("%s", self.state)
        finally:
            self._waiting.clear()
            with suppress(OSError):
                self._tape.close()

    def _write(self) -> None:
        """Write all that waits. A frame is on the disk before the tape speaks of it."""
        if self._bytes_put - self._bytes_written > WAITING_BYTES or len(self._waiting) > WAITING_NOTES:
            raise OSError(errno.EIO, "the disk is too slow for it")
        notes = []
        for _ in range(len(self._waiting)):
            each = self._waiting.popleft()
            if isinstance(each, bytes):
                notes.append(each)
            else:
                self._write_frame(*each)
        if not notes:
            return
        disk = os.fstatvfs(self._tape.fileno())
        if disk.f_bavail * disk.f_frsize < SPARED_BYTES:
            raise OSError(errno.ENOSPC, f"less than {SPARED_BYTES // 1_000_000} MB are left on the disk")
        if self._bytes_written + os.fstat(self._tape.fileno()).st_size > self._most_bytes:
            raise OSError(errno.EFBIG, "it is as large as half of log.record_mb allows")
        append(self._tape, b"".join(notes))
        sync(self._tape)

    def _write_frame(self, number: int, jpeg: bytes) -> None:
        with open_appending(frame_path(self.path, number)) as file:
            append(file, jpeg)
            sync(file)
        self._bytes_written += len(jpeg)

    def _delete_oldest(self) -> None:
        *earlier, _ = recordings(self.path.parent)
        taken = {folder: _size(folder) for folder in earlier}
        for folder in earlier:
            if sum(taken.values()) <= self._most_bytes:
                return
            shutil.rmtree(folder)
            del taken[folder]
            _log.info("the recording %s is deleted, to make room for this flight's", folder)


def _encoded(data: bytes) -> str:
    """Return bytes as JSON holds them."""
    return b64encode(data).decode()


def frame_path(folder: Path, number: int) -> Path:
    """Return the path of a picture in the folder of a recording."""
    return folder / FRAMES / f"{number:06d}.jpg"


def recording_of(said: str | None, log: str | Path) -> Path | None:
    """Find the recording that a flight's log speaks of: where it was, or in a folder of that name beside the log. None
    where it is in neither."""
    if not said:
        return None
    here = Path(said)
    beside = Path(log).resolve().parent / here.parent.name / here.name
    return next((each for each in (here, beside) if (each / TAPE).is_file()), None)


def frames_of(folder: Path) -> dict[str, Path]:
    """Return the frames of a recording by the names that the log gives them."""
    found = {}
    with open(folder / TAPE, "rb") as tape:
        for line in tape:
            with suppress(ValueError, LookupError, TypeError):  # a line that was cut, or no frame
                if line.startswith(b'["frame", {'):
                    known = json.loads(line)[1]
                    found[known["name"]] = frame_path(folder, known["number"])
    return found


def recordings(folder: Path) -> list[Path]:
    """List the folders of the recordings in a folder, the oldest first."""
    numbered = [(int(found[1]), each) for each in folder.iterdir() if (found := _FOLDER.fullmatch(each.name))]
    return [each for _, each in sorted(numbered)]


def _new_folder(folder: Path) -> Path:
    while True:
        last = max((int(each.name.rpartition("-")[2]) for each in recordings(folder)), default=0)
        path = folder / f"flight-{last + 1:04d}"
        with suppress(FileExistsError):  # another flight that has begun meanwhile has it
            path.mkdir(mode=0o750)
            return path


def _size(folder: Path) -> int:
    return sum(each.stat().st_size for each in folder.rglob("*") if each.is_file())
