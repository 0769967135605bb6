"""The log of a flight beside that of its replay."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

Line = dict[str, Any]

# Of the first line: they tell of the program that flew, and not of the flight.
PROGRAM = "version", "machine", "python", "libraries"


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A line that differs: its kind, its time, the query that it tells of (None: it tells of none), and what differs:
    of each field, by its dotted name, the value then and now. `in_flight` and
    `in_replay` tell whether there is such a line at all."""

    kind: str
    t_mono_s: float
    query: str | None
    fields: dict[str, tuple[Any, Any]]
    in_flight: bool = True
    in_replay: bool = True


@dataclass(frozen=True, slots=True)
class Lines:
    """Comparison of two logs: how many lines are `alike`, which ones differ, how many of the flight come after the end
    of the replay, and what differs in the `program`s that flew, by its name: then and now."""

    alike: int
    others: list[Difference]
    after: int
    program: dict[str, tuple[Any, Any]]


def compare(then: Iterable[Line], now: Iterable[Line]) -> Lines:
    """Compare the lines of a flight's log with those of its replay. A line that a full disk has cost the flight is no
    difference: its log says so, in a line of kind "gap"."""
    before, after = dict(_keyed(then)), dict(_keyed(now))
    has_gaps = any(line["kind"] == "gap" for line in before.values())
    last_s = max((line["t_mono_s"] for line in after.values()), default=0.0)
    alike, others, later = 0, [], 0
    program: dict[str, tuple[Any, Any]] = {}
    for key, line in before.items():
        if line["kind"] == "gap":
            continue
        if key not in after:
            if line["t_mono_s"] > last_s:
                later += 1
            else:
                others.append(_difference(key, {}, in_replay=False))
        else:
            fields = dict(_differing(line, after[key]))
            if line["kind"] == "start":
                program |= {name: each for name, each in fields.items() if name.partition(".")[0] in PROGRAM}
            if fields := {name: each for name, each in fields.items() if name not in program}:
                others.append(_difference(key, fields))
            else:
                alike += 1
    if not has_gaps:
        others += [_difference(key, {}, in_flight=False) for key in after if key not in before]
    return Lines(alike, others, later, program)


def _difference(key: tuple[Any, ...], fields: dict[str, tuple[Any, Any]], **where: bool) -> Difference:
    kind, t_mono_s, query, _ = key
    return Difference(kind=kind, t_mono_s=t_mono_s, query=query, fields=fields, **where)


def _keyed(lines: Iterable[Line]) -> Iterator[tuple[tuple[Any, ...], Line]]:
    """Yield each line with what names it: its kind, time and query, and which it is of several with the same."""
    seen: Counter[tuple[Any, ...]] = Counter()
    for line in lines:
        name = line.get("kind"), line.get("t_mono_s") or 0.0, line.get("query")
        yield (*name, seen[name]), line
        seen[name] += 1


def _differing(then: Any, now: Any, name: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    if isinstance(then, dict) and isinstance(now, dict):
        for key in then | now:
            yield from _differing(then.get(key), now.get(key), f"{name}.{key}" if name else key)
    elif then != now or type(then) is not type(now):
        yield name, (then, now)
