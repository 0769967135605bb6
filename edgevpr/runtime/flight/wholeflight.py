"""Reading of a whole flight, which may be spread over several files of its log. All programs that read a flight after
its end use it."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgevpr.core.appending import relatives
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.runtime.flight.flightlog import read_log, record_of

Line = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightLines:
    """The lines of one flight; iterate over them as often as needed. They are read from the `files`, in order. `flight`
    identifies the flight by its start line: (time in UTC, time on the monotonic clock), None without a start line.
    `missing` is a sentence about files that are missing (None: none are)."""

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
                    is_ours = _identity(line) == self.flight
                    if is_ours and has_start:
                        continue
                    has_start |= is_ours
                if is_ours and isinstance(line.get("kind"), str):
                    yield line


def flight_of(path: str | Path) -> FlightLines:
    """Find the lines of the last flight in a file of a log.

    If the flight has several files, it is read from its start to the end of this file. Raises UsageError if there is no
    such file, and EdgevprError if the file has no line of a flight.
    """
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"{path}: there is no such flight log: give the file that `log.path` names.")
    if not any(isinstance(line.get("kind"), str) for line in read_log(path)):
        raise EdgevprError(f"{path} holds no line of a flight log: give one that a flight has written.")
    starts = _starts(path)
    if not starts:
        return FlightLines(files=(path,), flight=None, missing=None)
    flight = _identity(starts[-1])
    parts = {path: _parts(starts, flight)}
    if min(parts[path]) > 1:
        with suppress(OSError):
            for other in relatives(path):
                with suppress(OSError):  # a file that may not be read counts as missing
                    found = _parts(_starts(other), flight)
                    if found and min(found) < min(parts[path]):
                        parts[other] = found
    lacking = max(parts[path]) - sum(map(len, parts.values()))
    missing = f"Files of the flight that are missing before {path}: {lacking}. The flight is read without them."
    files = tuple(sorted(parts, key=lambda file: min(parts[file])))
    return FlightLines(files=files, flight=flight, missing=missing if lacking > 0 else None)


def _starts(path: Path) -> list[Line]:
    """Return the start lines in a file, in order. Raises OSError."""
    with open(path, "rb") as handle:
        lines = [record_of(line) or {} for line in handle if b'"start"' in line]
    return [line for line in lines if line.get("kind") == "start"]


def _identity(start: Line) -> tuple[object, object]:
    return start.get("time"), start.get("t_mono_s")


def _parts(starts: list[Line], flight: tuple[object, object]) -> list[int]:
    """Return the numbers of the parts of a flight that begin with these start lines. Each part of a flight has one, and
    all but that of the first part are marked as repeated."""
    ours = [start for start in starts if _identity(start) == flight]
    numbers = [start.get("part") if start.get("repeated") else 1 for start in ours]
    return [number if isinstance(number, int) and number >= 1 else 1 for number in numbers]
