"""The flight log: one JSON object a line, appended. A full disk or a pulled card loses lines, but never ends the
flight."""

import json
import logging
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, BinaryIO

from edgevpr import __version__
from edgevpr.config import Config
from edgevpr.contract import TechniqueSpec
from edgevpr.errors import EdgevprError
from edgevpr.helpers.appending import append, is_at, open_appending, set_aside, sync
from edgevpr.helpers.jsonline import json_line

_log = logging.getLogger(__name__)
_SYNC_EVERY_S = 1.0


class FlightLog:
    """An open flight log; `path=None` writes nothing. Close it (it is a context manager).

    `state` is None while lines are written, else a sentence that says why they are not. `lost_lines` counts the missing
    lines. Every write tries again, and the first one that succeeds is preceded by a line of kind "gap". A log that was
    deleted or moved in flight goes on in a new file of that name.

    A file of half of `max_mb` (None: without limit) is renamed to `earlier_part`, and the log goes on in a new file.
    Every file that begins in flight begins with the line of kind "start" again, with `repeated`, so that it can be read
    alone.
    """

    def __init__(
        self,
        path: str | Path | None,
        clock: Callable[[], float] = time.monotonic,
        wait: bool = False,
        max_mb: float | None = None,
    ) -> None:
        """Open for appending. Raises EdgevprError where the file cannot be opened. With `wait`, for a service that may
        restart in the air, every line tries to open the file again instead."""
        self.path = path
        self.state: str | None = None
        self.lost_lines = 0
        self._clock = clock
        self._synced_s = -math.inf
        self._file: BinaryIO | None = None
        self._written = 0  # lines in the file that is open
        self._part_bytes = math.inf if max_mb is None else 1e6 * max_mb / 2
        self._is_bounded = True
        self._start, self._has_start = (
            b"",
            True,
        )  # the start line as it is repeated; the open file has it, or needs none
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

    def __enter__(self) -> "FlightLog":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, kind: str, **fields: Any) -> None:
        """Append one line: `kind`, the time (UTC), `t_mono_s` (now, unless given) and the fields. Never raises OSError.

        Dataclasses become objects, NaN and infinities null. The line is in the file on return, and on the disk
        within a second of writing.
        """
        if self.path is None:
            return
        if self._file is not None and not is_at(self._file, self.path):
            self._note_taken_away()
        lines = _line(kind, {"t_mono_s": self._clock(), **fields})
        if kind == "start":
            self._start = lines.removesuffix(b"}\n") + b', "repeated": true}\n'
        if self.state is not None:
            lines = _line("gap", {"t_mono_s": self._clock(), "lost_lines": self.lost_lines}) + lines
        try:
            if self._file is None:
                self._open()
            self._make_room(len(lines))
            _append(self._file, lines if self._has_start or kind == "start" else self._start + lines)
            self._has_start = True
            if self._clock() - self._synced_s >= _SYNC_EVERY_S:
                self._sync()
        except OSError as error:
            self._lost_one(kind, error)
        else:
            self._written += 1
            self._say_recovered()

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
        self._file, self._written = open_appending(self.path), 0
        if os.fstat(self._file.fileno()).st_size == 0:
            self._has_start = False

    def _make_room(self, more_bytes: int) -> None:
        """Begin a new part where the file would become too large. One that cannot be renamed is written on: a line is
        worth more than the limit."""
        size = os.fstat(self._file.fileno()).st_size
        if not size or size + len(self._start) + more_bytes <= self._part_bytes:
            return
        try:
            set_aside(self.path)
        except OSError as error:
            if self._is_bounded:
                self._is_bounded = False
                _log.warning(
                    "The flight log %s grows past log.max_mb, since it cannot be renamed (%s): let the flight write to "
                    "its folder.",
                    self.path,
                    error.strerror,
                )
            return
        self._sync()
        self._let_go()
        self._open()

    def _sync(self) -> None:
        sync(self._file)
        self._synced_s = self._clock()

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
            f"The flight log {self.path} was {'deleted' if is_deleted else 'moved or replaced'} in flight, and {lost} "
            "lines of it are lost: it goes on in a new file as soon as there can be one."
        )
        _log.warning("%s", self.state)
        self._let_go()
        self._has_start = False

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


def start_fields(config: Config, board_name: str, spec: TechniqueSpec) -> dict[str, Any]:
    """Return the fields of a flight's first line, of kind "start": version, technique, board, map and configuration."""
    return {
        "version": __version__,
        "technique": spec.name,
        "parameters": spec.parameters,
        "board": board_name,
        "map": config.map,
        "config": asdict(config),
    }


def read_log(path: str | Path) -> Iterator[dict[str, Any]]:
    """Yield the lines of a flight log as dicts, in order. A line that was cut (battery pulled) is left out."""
    with open(path, "rb") as handle:
        for line in handle:
            try:
                record = json.loads(line)
            except (ValueError, RecursionError):
                continue
            if isinstance(record, dict):
                yield record


def _append(file: BinaryIO, lines: bytes) -> None:
    end = file.seek(0, os.SEEK_END)
    if end:
        file.seek(end - 1)
        if file.read(1) != b"\n":  # cut by a pulled battery, or by a failure that could not be undone
            lines = b"\n" + lines
    append(file, lines)


def _line(kind: str, fields: dict[str, Any]) -> bytes:
    now = datetime.now(timezone.utc).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    return json_line({"kind": kind, "time": now, **fields})
