"""Reading of a whole flight, which may be spread over several files of its log. All programs that read a flight after
its end use it."""

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgevpr.core.appending import relatives
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.runtime.flight.flightlog import read_log, record_of

Line = dict[str, Any]

_MISSING = "Files of the flight that are missing before {}: {}. The flight is read without them."


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """The lines of one flight in one file, from byte `begin` to byte `end`. `start` is their first start line ({}:
    there is none). `parts` are the numbers of the parts of the flight that begin here, usually one."""

    path: Path
    begin: int
    end: int
    start: Line
    parts: frozenset[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightLines:
    """The lines of one flight; iterate over them as often as needed. It is flight `number` of the `flights` in the file
    `path`, and is read from `stretches` of files, in order. `missing` is a sentence about files that are missing (None:
    none are)."""

    path: Path
    number: int
    flights: int
    missing: str | None
    stretches: tuple[Stretch, ...]

    def __iter__(self) -> Iterator[Line]:
        """Yield the lines, each with a `kind`; only the first start line is included."""
        has_start = False
        for stretch in self.stretches:
            for line in read_log(stretch.path, stretch.begin, stretch.end):
                is_start = line.get("kind") == "start"
                if isinstance(line.get("kind"), str) and not (is_start and has_start):
                    yield line
                has_start |= is_start


def flight_of(path: str | Path, number: int | None = None) -> FlightLines:
    """Find the lines of one flight in a log: the last flight in the file, unless its `number` (1, 2, ...) is given.

    If the flight has several files, it is read from its start to the end of this file. Raises UsageError if there is no
    such file or flight, and EdgevprError if the file has no line of a flight.
    """
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"{path}: there is no such flight log: give the file that `log.path` names.")
    found = _stretches(path)
    if not found:
        raise EdgevprError(f"{path} holds no line of a flight log: give one that a flight has written.")
    if number is not None and not 1 <= number <= len(found):
        raise UsageError(f"--flight {number}: {path} holds {len(found)}: give 1 to {len(found)}.")
    last = found[(number or 0) - 1]
    earlier = _earlier(last)
    known = {part for each in (*earlier, last) for part in each.parts}
    lacking = max(last.parts, default=1) - len(known)
    return FlightLines(
        path=path,
        number=number or len(found),
        flights=len(found),
        missing=_MISSING.format(path, lacking) if lacking > 0 else None,
        stretches=(*earlier, last),
    )


def _earlier(last: Stretch) -> list[Stretch]:
    """Find the stretches, in other files, with the parts of the same flight before `last`, in order."""
    first = min(last.parts, default=1)
    found = {}
    for path in _relatives(last.path) if first > 1 else ():
        for each in _stretches(path):
            if each.parts and min(each.parts) < first and _flight(each.start) == _flight(last.start):
                found[min(each.parts)] = each
    return [each for _, each in sorted(found.items())]


def _relatives(path: Path) -> list[Path]:
    with suppress(OSError):
        return [each for each in relatives(path) if each.is_file() and os.access(each, os.R_OK)]
    return []


def _stretches(path: Path) -> list[Stretch]:
    """Find the flights in a file. Lines before the first start line count as a flight too. Raises OSError."""
    begins: list[tuple[int, Line, set[int]]] = []
    end = 0
    with open(path, "rb") as handle:
        for line in handle:
            # After the first line, only start lines matter: others are not parsed.
            record = (record_of(line) if not begins or b'"start"' in line else None) or {}
            kind = record.get("kind")
            if kind == "start":
                if not begins or not record.get("repeated") or _flight(record) != _flight(begins[-1][1]):
                    begins.append((end, record, set()))
                begins[-1][2].add(_part(record))
            elif isinstance(kind, str) and not begins:
                begins.append((end, {}, set()))
            end += len(line)
    ends = [begin for begin, *_ in begins[1:]] + [end]
    return [
        Stretch(path=path, begin=begin, end=last, start=start, parts=frozenset(parts))
        for (begin, start, parts), last in zip(begins, ends, strict=False)
    ]


def _flight(start: Line) -> tuple[object, object]:
    """Return the values of a start line that identify its flight."""
    return start.get("time"), start.get("t_mono_s")


def _part(start: Line) -> int:
    part = start.get("part") if start.get("repeated") else 1
    return part if isinstance(part, int) and part >= 1 else 1
