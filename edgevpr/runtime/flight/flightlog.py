"""The flight log: one JSON object per line. `flight` writes it; all programs that read a finished flight use
`select_last_flight`. A full disk or a removed memory card loses lines, but never ends the flight."""

import errno
import json
import logging
import math
import os
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from io import FileIO
from pathlib import Path
from typing import Any

from edgevpr.core import appending
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.text import format_json_line

Line = dict[str, Any]

_log = logging.getLogger(__name__)
_MAX_FILES = 4  # that use `max_mb` together: the current file and three numbered ones
_SYNC_INTERVAL_S = 1.0


class FlightLog(AbstractContextManager["FlightLog"]):
    """Writer of a flight log (a context manager); with `path` None nothing is written.

    `path` is the log of the newest flight. The file of an earlier flight is rotated: renamed to the next number (see
    `core.appending`), as is a file that reaches a quarter of `max_mb` (None: no limit). The numbered files use the
    rest; the oldest are deleted. Each further file of a flight begins with a copy of the start line and two more
    fields: `repeated` (true) and `part`, the number of the file within the flight.

    Each line is written to the operating system at once: if this process ends, no line is lost. Lines are synced at
    most once a second: a power cut loses the lines of the last two seconds.

    `fault` is None while lines are written, else a sentence with the reason; `lost_lines` counts lines that could not
    be written. Every write tries again, and the first that succeeds is preceded by a line of kind "gap". If the log is
    deleted or moved in flight, logging continues in a new file.
    """

    def __init__(
        self,
        path: str | Path | None,
        clock: Callable[[], float] = time.monotonic,
        utc_s: Callable[[], float] = time.time,
        *,
        retries: bool = False,
        max_mb: float | None = None,
    ) -> None:
        """Open the file. Raises EdgevprError if that fails; with `retries`, for a service that may be restarted in the
        air, every line tries again instead. `clock` returns monotonic seconds."""
        self.path = path
        self.fault: str | None = None
        self.lost_lines = 0
        self._clock, self._utc_s = clock, utc_s
        self._path = Path(path or "")
        self._part_bytes = math.inf if max_mb is None else 1e6 * max_mb / _MAX_FILES
        self._file: FileIO | None = None
        self._own_identity: tuple[int, int] | None = None  # device and inode of the file with lines of this flight
        self._synced_s, self._is_synced = -math.inf, True
        self._start: dict[str, Any] = {}  # the start line, for the copies in later files
        self._part = 0  # start lines written so far
        self._warned: set[str] = set()
        if path is not None:
            try:
                self._open()
            except OSError as error:
                if not retries:
                    raise EdgevprError(
                        f"The flight log {path} cannot be opened ({error.strerror}): use one file per flight, "
                        "in a folder that exists and is writable."
                    ) from error
                self._record_error(error)

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, kind: str, **fields: Any) -> None:
        """Append one line: `kind`, the time (UTC), `t_mono_s` (now, unless given) and the fields; NaN becomes null.
        Never raises OSError."""
        if self.path is None:
            return
        if self._file is not None and not appending.is_same_file(self._file, self._path):
            self._warn(f"The flight log {self._path} was deleted or moved in flight; logging continues in a new file.")
            self._close_file()
        now_s, utc_s = self._clock(), self._utc_s()
        lines, is_start = _make_line(kind, utc_s, {"t_mono_s": now_s, **fields}), kind == "start"
        if is_start:
            self._start, self._part = json.loads(lines), 0
        if self.fault is not None:
            gap = _make_line("gap", utc_s, {"t_mono_s": now_s, "lost_lines": self.lost_lines})
            lines = lines + gap if is_start else gap + lines
        try:
            file = self._prepare_file(len(lines))
            if self._start and not is_start and _read_identity(file) != self._own_identity:
                is_start = True
                lines = format_json_line({**self._start, "repeated": True, "part": self._part + 1}) + lines
            _append(file, lines)
            self._own_identity, self._is_synced = _read_identity(file), False
            self._part += is_start
            if now_s - self._synced_s >= _SYNC_INTERVAL_S:
                self._sync(file, now_s)
        except OSError as error:
            self.lost_lines += 1
            self._record_error(error)
        else:
            if self.fault is not None:
                self.fault = None
                _log.warning("Logging to %s has resumed; %d lines were lost.", self.path, self.lost_lines)

    def sync_if_due(self, now_s: float) -> None:
        """Sync lines to the disk if the last sync was a second ago or more; `now_s` is the time. Never raises."""
        if self._file is None or self._is_synced or now_s - self._synced_s < _SYNC_INTERVAL_S:
            return
        try:
            self._sync(self._file, now_s)
        except OSError as error:
            self._record_error(error)

    def close(self) -> None:
        """Sync all lines to the disk and close the file. A failure is logged, not raised."""
        if self._file is None:
            return
        try:
            self._sync(self._file, self._synced_s)
            self._file.close()
        except OSError as error:
            _log.warning("The end of the flight log %s may be missing (%s).", self.path, error.strerror)
        self._file = None

    def _prepare_file(self, more_bytes: int) -> FileIO:
        """Return the open file. A file without room for `more_bytes`, or of an earlier flight, is rotated first. If
        that fails, the file grows beyond the limit: lines matter more. Raises OSError."""
        file = self._file or self._open()
        size, is_ours = _read_size(file), _read_identity(file) == self._own_identity
        if not size or (is_ours and size + more_bytes <= self._part_bytes):
            return file
        try:
            appending.rotate_file(self._path)
        except OSError as error:
            self._warn(
                f"The flight log {self.path} cannot be rotated ({error.strerror}), so it grows and may "
                "exceed log.max_mb: make its folder writable for the flight."
            )
            return file
        appending.sync_file(file)
        self._close_file()
        if not math.isinf(self._part_bytes):
            with suppress(OSError):
                appending.delete_oldest(self._path, self._part_bytes * (_MAX_FILES - 1))
        return self._open()

    def _open(self) -> FileIO:
        """Open and lock the file. Raises OSError, also if another process has locked it."""
        file = appending.open_appending(self._path)
        if not appending.try_lock(file):
            file.close()
            raise OSError(errno.EBUSY, "another edgevpr process writes to it", str(self._path))
        self._file = file
        if not _read_size(file):  # on another disk, its device and inode may equal those of an earlier file
            self._own_identity = None
            appending.sync_folder(self._path)
        return file

    def _sync(self, file: FileIO, now_s: float) -> None:
        appending.sync_file(file)
        self._is_synced, self._synced_s = True, now_s

    def _record_error(self, error: OSError) -> None:
        """Record that the file cannot be written. The next line reopens it, since the card may have been replaced."""
        if self.fault is None:
            self.fault = (
                f"The flight log {self.path} cannot be written ({error.strerror}): free space or insert the card; "
                "the flight continues without it."
            )
            _log.warning("%s", self.fault)
        self._close_file()

    def _close_file(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None

    def _warn(self, sentence: str) -> None:
        """Log a warning once per flight."""
        if sentence not in self._warned:
            self._warned.add(sentence)
            _log.warning("%s", sentence)


def _append(file: FileIO, lines: bytes) -> None:
    end = file.seek(0, os.SEEK_END)
    if end:
        file.seek(end - 1)
        if file.read(1) != b"\n":  # truncated by a power cut, or by a failure that could not be undone
            lines = b"\n" + lines
    appending.append_bytes(file, lines)


def _make_line(kind: str, utc_s: float, fields: dict[str, Any]) -> bytes:
    now = datetime.fromtimestamp(utc_s, timezone.utc).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    return format_json_line({"kind": kind, "time": now, **fields})


def _read_identity(file: FileIO) -> tuple[int, int]:
    """Return the device and inode numbers of an open file, which identify it."""
    status = os.fstat(file.fileno())
    return status.st_dev, status.st_ino


def _read_size(file: FileIO) -> int:
    """Return the size of an open file in bytes, 0 for a device."""
    status = os.fstat(file.fileno())
    return status.st_size if stat.S_ISREG(status.st_mode) else 0


def read_log(path: str | Path) -> Iterator[Line]:
    """Yield the lines of one log file as dicts, in order. A truncated line (power cut) is skipped."""
    with open(path, "rb") as handle:
        for line in handle:
            record = _parse_line(line)
            if record is not None:
                yield record


def _parse_line(line: bytes) -> Line | None:
    """Parse one line of a log; None if it is truncated or not a JSON object."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightLines:
    """The lines of one flight, read from its `files`; iterate over them as often as needed. `flight` identifies it by
    its start line: (time in UTC, time on the monotonic clock), None without one. `missing` is a sentence about missing
    files (None: the flight is complete)."""

    files: tuple[Path, ...]
    flight: tuple[object, object] | None
    missing: str | None

    def __iter__(self) -> Iterator[Line]:
        """Yield the lines, each with a `kind`; only the first start line is included."""
        has_start = False
        for file in self.files:
            is_ours = self.flight is None
            for line in read_log(file):
                if line.get("kind") == "start":
                    is_ours = _read_flight_id(line) == self.flight
                    if is_ours and has_start:
                        continue
                    has_start |= is_ours
                if is_ours and isinstance(line.get("kind"), str):
                    yield line


def select_last_flight(path: str | Path) -> FlightLines:
    """Find the lines of the last flight in a file of a log, from its start in earlier files to the end of this one.
    Raises UsageError if there is no such file, and EdgevprError if it contains no flight-log lines."""
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"There is no flight log {path}: use the file that is set as `log.path`.")
    if not any(isinstance(line.get("kind"), str) for line in read_log(path)):
        raise EdgevprError(f"{path} contains no flight-log lines: use a log written by a flight.")
    starts = _read_starts(path)
    if not starts:
        return FlightLines(files=(path,), flight=None, missing=None)
    flight = _read_flight_id(starts[-1])
    parts = {path: _find_parts(starts, flight)}
    if min(parts[path]) > 1:
        with suppress(OSError):
            for other in appending.list_related(path):
                with suppress(OSError):  # an unreadable file counts as missing
                    numbers = _find_parts(_read_starts(other), flight)
                    if numbers and min(numbers) < min(parts[path]):
                        parts[other] = numbers
    missing_count = max(parts[path]) - sum(map(len, parts.values()))
    missing = f"Files of this flight before {path} are missing ({missing_count}): it is read without them."
    files = tuple(sorted(parts, key=lambda file: min(parts[file])))
    return FlightLines(files=files, flight=flight, missing=missing if missing_count > 0 else None)


def _read_starts(path: Path) -> list[Line]:
    """Return the start lines in a file, in order. Raises OSError."""
    with open(path, "rb") as handle:
        lines = [_parse_line(line) or {} for line in handle if b'"start"' in line]
    return [line for line in lines if line.get("kind") == "start"]


def _read_flight_id(start: Line) -> tuple[object, object]:
    return start.get("time"), start.get("t_mono_s")


def _find_parts(starts: list[Line], flight: tuple[object, object]) -> list[int]:
    """Return the numbers of the parts of a flight that begin with these start lines: 1 unless it is repeated."""
    ours = [start for start in starts if _read_flight_id(start) == flight]
    numbers = [start.get("part") if start.get("repeated") else 1 for start in ours]
    return [number if isinstance(number, int) and number >= 1 else 1 for number in numbers]
