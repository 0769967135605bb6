"""The flight log: one JSON object a line. A full disk or a pulled card loses lines, but never ends the flight."""

import json
import logging
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, BinaryIO

from edgevpr.core.appending import append, is_at, sync, sync_folder
from edgevpr.core.errors import EdgevprError
from edgevpr.core.text import json_line
from edgevpr.core.types import NO_TAPE, Tape
from edgevpr.runtime.flight.logfiles import LogFiles, identity, size_of

_log = logging.getLogger(__name__)
_SYNC_EVERY_S = 1.0
_MOST_START_BYTES = 1_000_000  # of a file that is looked through for anything but start lines


class FlightLog:
    """An open flight log; `path=None` writes nothing. Close it (it is a context manager).

    `path` is the log of the newest flight. What is there of an earlier flight is set aside under the next number
    (`helpers.numbered`) before the first line is written, unless it is nothing but start lines. So is a file of a
    quarter of `max_mb` (None: without limit). The files with numbers have the other three quarters: the oldest are
    deleted. Every file of a flight but the first begins with the flight's start line again, with `repeated`, and
    `part`, the number of the file among those of the flight. Where another process writes `path`, this flight has files
    with numbers only.

    A line is the system's as soon as it is written: the end of this process, however sudden, costs nothing. It is on
    the disk (fdatasync) with the first line that comes a second or more after the last sync, or with the next call of
    `sync_due`. A pulled battery costs at most the lines of the last two seconds.

    `state` is None while lines are written, else a sentence that says why they are not. `lost_lines` counts the missing
    lines. Every write tries again, and the first one that succeeds is preceded by a line of kind "gap". A log that was
    deleted or moved in flight goes on in a new file of that name.
    """

    def __init__(
        self,
        path: str | Path | None,
        clock: Callable[[], float] = time.monotonic,
        utc_s: Callable[[], float] = time.time,
        *,
        wait: bool = False,
        max_mb: float | None = None,
        tape: Tape = NO_TAPE,
    ) -> None:
        """Open for appending. Raises EdgevprError where the file cannot be opened. With `wait`, for a service that may
        restart in the air, every line tries to open the file again instead."""
        self.path = path
        self.state: str | None = None
        self.lost_lines = 0
        self._clock, self._utc_s, self._tape = clock, utc_s, tape
        self._synced_s = -math.inf
        self._is_synced, self._is_new = True, False
        self._files = LogFiles(path or "", max_mb)
        self._file: BinaryIO | None = None
        self._ours: tuple[int, int] | None = None  # device and inode of the file with lines of this flight
        self._written = 0  # lines in the file that is open
        self._start: dict[str, Any] = {}  # the start line, as it is repeated
        self._part, self._has_start = 0, False  # start lines written so far; the open file has one
        if path is not None:
            try:
                self._open()
            except OSError as error:
                if wait:
                    self._note_trouble(error)
                    return
                raise EdgevprError(
                    f"The flight log {path} cannot be opened ({error.strerror}): give a file in a folder that is there "
                    "and may be written to."
                ) from error

    @property
    def is_written(self) -> bool:
        """True where lines are written, as far as that was noticed."""
        return self._tape.read("log is written", lambda: self.state is None)

    def __enter__(self) -> "FlightLog":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, kind: str, **fields: Any) -> None:
        """Append one line: `kind`, the time (UTC), `t_mono_s` (now, unless given) and the fields. Never raises OSError.

        Dataclasses become objects, NaN and infinities null. The line is in the file on return.
        """
        if self.path is None:
            return
        if self._file is not None and not is_at(self._file, self._files.at):
            self._note_taken_away()
        now_s, utc_s = self._clock(), self._utc_s()
        lines = _line(kind, utc_s, {"t_mono_s": now_s, **fields})
        if kind == "start":
            self._start, self._part = json.loads(lines), 0
        if self.state is not None:
            gap = _line("gap", utc_s, {"t_mono_s": now_s, "lost_lines": self.lost_lines})
            lines = lines + gap if kind == "start" else gap + lines
        try:
            if self._file is None:
                self._open()
            if self._is_to_be_set_aside(len(lines)):
                self._begin_anew()
            is_repeated = bool(self._start) and not self._has_start and kind != "start"
            if is_repeated:
                lines = json_line({**self._start, "repeated": True, "part": self._part + 1}) + lines
            _append(self._file, lines)
            self._note_written(with_start=is_repeated or kind == "start")
            if now_s - self._synced_s >= _SYNC_EVERY_S:
                self._sync()
                self._synced_s = now_s
        except OSError as error:
            self._lost_one(kind, error)
        else:
            self._say_recovered()

    def restate(self, **fields: Any) -> None:
        """Give fields of the start line another value, where it is repeated from now on."""
        if self._start:
            self._start |= json.loads(json_line(fields))

    def sync_due(self, now_s: float) -> None:
        """Bring lines to the disk that no other line has followed for a second; `now_s` is the time by the clock. Never
        raises OSError."""
        if self._file is None or self._is_synced or now_s - self._synced_s < _SYNC_EVERY_S:
            return
        try:
            self._sync()
            self._synced_s = now_s
        except OSError as error:
            self._note_trouble(error)
            self._let_go()

    def close(self) -> None:
        """Bring everything to the disk. A failure is logged, not raised."""
        if self._file is None:
            return
        try:
            self._sync()
            self._file.close()
        except OSError as error:
            _log.warning("The end of the flight log %s may be missing (%s).", self.path, error.strerror)
        self._file = None

    def _open(self) -> None:
        self._file = self._files.open()
        self._written, self._is_new = 0, not size_of(self._file)
        self._has_start &= not self._is_new and identity(self._file) == self._ours

    def _is_to_be_set_aside(self, more_bytes: int) -> bool:
        size = size_of(self._file)
        return size > 0 and (identity(self._file) != self._ours or size + more_bytes > self._files.part_bytes)

    def _begin_anew(self) -> None:
        if self._ours is None and _has_only_starts(self._file):  # of a service that could not start
            self._file.truncate(0)
        elif self._files.set_aside():
            sync(self._file)
            self._let_go()
            self._files.delete_oldest()
            self._open()

    def _note_written(self, with_start: bool) -> None:
        self._ours, self._is_synced = identity(self._file), False
        self._written += 1
        if with_start:
            self._part += 1
            self._has_start = True

    def _sync(self) -> None:
        sync(self._file)
        if self._is_new:
            sync_folder(self._files.at)
        self._is_synced, self._is_new = True, False

    def _lost_one(self, kind: str, error: OSError) -> None:
        self.lost_lines += 1
        if kind == "start":
            self._has_start = False
        self._note_trouble(error)
        self._let_go()  # the medium may be another one when it comes back, so the file is opened anew

    def _note_taken_away(self) -> None:
        is_deleted = os.fstat(self._file.fileno()).st_nlink == 0
        lost = self._written if is_deleted else 0
        self.lost_lines += lost
        self.state = (
            f"The flight log {self._files.at} was {'deleted' if is_deleted else 'moved or replaced'} in flight, and "
            f"{lost} lines of it are lost: it goes on in a new file as soon as there can be one."
        )
        _log.warning("%s", self.state)
        self._let_go()
        self._ours, self._has_start = None, False

    def _let_go(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None

    def _note_trouble(self, error: OSError) -> None:
        if self.state is None:
            self.state = (
                f"The flight log {self.path} cannot be written ({error.strerror}): make room or put the medium back; "
                "the flight goes on without it."
            )
            _log.warning("%s", self.state)

    def _say_recovered(self) -> None:
        if self.state is not None:
            self.state = None
            _log.warning("The flight log %s is written again; %d lines are missing.", self.path, self.lost_lines)


def read_log(path: str | Path, begin: int = 0, end: float = math.inf) -> Iterator[dict[str, Any]]:
    """Yield the lines of a file as dicts, in order; with `begin` and `end` those that begin there, in bytes. A line
    that was cut (battery pulled) is left out. `wholeflight.flight_of` reads a flight of several files."""
    with open(path, "rb") as handle:
        handle.seek(begin)
        for line in handle:
            if begin >= end:
                return
            begin += len(line)
            record = record_of(line)
            if record is not None:
                yield record


def record_of(line: bytes) -> dict[str, Any] | None:
    """Return a line as a dict, None for one that was cut or is none."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


def _has_only_starts(file: BinaryIO) -> bool:
    if size_of(file) > _MOST_START_BYTES:
        return False
    file.seek(0)
    return all((record_of(line) or {}).get("kind") == "start" for line in file.readall().splitlines())


def _append(file: BinaryIO, lines: bytes) -> None:
    end = file.seek(0, os.SEEK_END)
    if end:
        file.seek(end - 1)
        if file.read(1) != b"\n":  # cut by a pulled battery, or by a failure that could not be undone
            lines = b"\n" + lines
    append(file, lines)


def _line(kind: str, utc_s: float, fields: dict[str, Any]) -> bytes:
    now = datetime.fromtimestamp(utc_s, timezone.utc).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    return json_line({"kind": kind, "time": now, **fields})
