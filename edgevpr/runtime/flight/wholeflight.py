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


@dataclass(slots=True, kw_only=True)
class Stretch:
    """The lines of one flight in one file, from byte `begin` to before byte `end`. `flight` identifies the flight by
    its start line: (time in UTC, time on the monotonic clock), None without a start line. A flight is split into
    numbered parts, each with a start line of its own: `first` and `last` are the numbers of the first and the last part
    in this file."""

    path: Path
    begin: int
    end: int
    flight: tuple[object, object] | None
    first: int
    last: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightLines:
    """The lines of one flight; iterate over them as often as needed. It is flight `number` (1, 2, ...) of the `flights`
    (their count) in the file `path`, and is read from the `stretches` of files, in order. `missing` is a sentence about
    files that are missing (None: none are)."""

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
    stretches = (*_earlier(last), last)
    lacking = last.last - sum(each.last - each.first + 1 for each in stretches)
    missing = f"Files of the flight that are missing before {path}: {lacking}. The flight is read without them."
    return FlightLines(
        path=path,
        number=number or len(found),
        flights=len(found),
        missing=missing if lacking > 0 else None,
        stretches=stretches,
    )


def _earlier(last: Stretch) -> list[Stretch]:
    """Find the stretches, in other files, with the parts of the same flight before `last`, in order."""
    found = []
    with suppress(OSError):
        for path in relatives(last.path) if last.first > 1 else ():
            with suppress(OSError):  # a file that may not be read counts as missing
                found += [each for each in _stretches(path) if each.flight == last.flight and each.first < last.first]
    return sorted(found, key=lambda each: each.first)


def _stretches(path: Path) -> list[Stretch]:
    """Return the stretch of each flight in a file, in order. Lines before the first start line count as a flight too.
    Raises OSError."""
    found: list[Stretch] = []
    end = 0
    with open(path, "rb") as handle:
        for line in handle:
            # After the first line, only start lines matter: others are not parsed.
            record = (record_of(line) if not found or b'"start"' in line else None) or {}
            is_start, part = record.get("kind") == "start", _part(record)
            flight = (record.get("time"), record.get("t_mono_s")) if is_start else None
            if is_start and found and record.get("repeated") and found[-1].flight == flight:
                found[-1].last = part
            elif is_start or (isinstance(record.get("kind"), str) and not found):
                found.append(Stretch(path=path, begin=end, end=end, flight=flight, first=part, last=part))
            end += len(line)
            if found:
                found[-1].end = end
    return found


def _part(start: Line) -> int:
    part = start.get("part") if start.get("repeated") else 1
    return part if isinstance(part, int) and part >= 1 else 1
