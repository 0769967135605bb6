"""`edgevpr replay`: fly a recorded flight again on the ground, and print how the replay differs from the flight."""

import logging
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.cli.shared import add_json, command, print_json
from edgevpr.core.text import shown

if TYPE_CHECKING:
    from edgevpr.review.compare import Difference, QueryResult
    from edgevpr.review.replay import Recorded, Replayed

_SHOWN = 40  # differences at most, without --json


def add(commands: Any) -> None:
    """Add the command and its flags."""
    replay = command(
        commands, "replay", run_replay, "fly a recorded flight again: the same, or with another configuration"
    )
    replay.add_argument("log", metavar="LOG", help="the flight log; its last flight is taken")
    replay.add_argument("--map", metavar="MAP", help="the flight's map (default: where it was)")
    replay.add_argument(
        "--config", metavar="FILE", help="what if: fly with the keys of this file, and put both side by side"
    )
    add_json(replay)


def run_replay(args: Namespace) -> int:
    """Run `replay`: fly a recorded flight again, and print the comparison."""
    from edgevpr.core.text import waiting
    from edgevpr.review.replay import recorded, replay

    def say(done: int, total: int) -> None:
        waiting(f"replaying  {done}/{total}")

    flight = recorded(args.log)
    with _unheard(getattr(args, "debug", False)):
        again = replay(flight, say, args.map, args.config and Path(args.config))
    waiting("")
    if args.config:
        return _print_beside(flight, again, args.json)
    return _print_comparison(flight, again, args.json)


@contextmanager
def _unheard(debug: bool) -> Iterator[None]:
    """Context manager: print only errors of the replayed flight (all with `debug`); its messages are in its journal."""
    log = logging.getLogger("edgevpr")
    before = log.level
    if not debug:
        log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(before)


def _print_comparison(flight: "Recorded", again: "Replayed", as_json: bool) -> int:
    from edgevpr.review.compare import compare, described

    lines, packets = compare(flight.lines, again.lines), again.packets
    said = [
        f"{each.t_s:.3f} s, {each.link}: said {described(each.then)}, now {described(each.now)}"
        for each in packets.others
    ]
    if as_json:
        print_json(
            {
                "lines": {
                    "alike": lines.alike,
                    "others": [asdict(each) for each in lines.others],
                    "after": lines.after,
                    "program": lines.program,
                },
                "packets": {"alike": packets.alike, "renumbered": packets.renumbered, "others": said},
                "guessed": again.guessed,
                "why_ended": again.why_ended,
            }
        )
        return 1 if lines.others or said or packets.renumbered else 0
    differences = [*(text for each in lines.others for text in _of_line(each)), *said]
    for text in differences[:_SHOWN]:
        print(shown(text))
    if len(differences) > _SHOWN:
        print(f"... and {len(differences) - _SHOWN} more (--json has all)")
    for name, (then, now) in lines.program.items():
        print(shown(f"The program differs: {name} was {then}, is {now}"))
    queries = sum(line.get("kind") == "query" for line in again.lines)
    print(f"{queries} queries flown again")
    print(f"log      {lines.alike} lines are the same, {len(lines.others)} differ")
    renumbered = f", {packets.renumbered} but for their number" if packets.renumbered else ""
    print(f"MAVLink  {packets.alike} packets are the same{renumbered}, {len(packets.others)} differ")
    if again.guessed:
        print(f"This edgevpr asks {again.guessed} times for something else than the one that flew: its costs differ.")
    if again.why_ended:
        print(shown(f"The replay ends before the flight: {again.why_ended}; {lines.after} lines come after it."))
    return 1 if differences or packets.renumbered else 0


def _print_beside(flight: "Recorded", again: "Replayed", as_json: bool) -> int:
    from edgevpr.review.compare import beside, table

    pairs = beside(flight.lines, again.lines)
    rows = table(pairs)
    if as_json:
        print_json(
            {"summary": {what: [then, now] for what, then, now in rows}, "queries": [asdict(pair) for pair in pairs]}
        )
        return 0
    others = [pair for pair in pairs if not pair.is_alike]
    for pair in others[:_SHOWN]:
        print(shown(f"{pair.query}: {_in_words(pair.then)}; what if: {_in_words(pair.now)}"))
    if len(others) > _SHOWN:
        print(f"... and {len(others) - _SHOWN} more (--json has all)")
    print(f"{'':<20} {'flight':>10} {'what if':>10}")
    for what, then, now in rows:
        print(f"{what:<20} {'-' if then is None else then:>10} {'-' if now is None else now:>10}")
    apart_m = [pair.apart_m for pair in pairs if pair.apart_m is not None]
    largest = f", their positions at most {max(apart_m):.1f} m apart" if apart_m else ""
    print(f"{len(pairs) - len(others)} of {len(pairs)} queries end alike{largest}")
    if again.why_ended:
        print(shown(f"It ends before the flight: {again.why_ended}."))
    return 0


def _of_line(difference: "Difference") -> list[str]:
    where = f"{difference.t_mono_s:.3f} s, {difference.query or difference.kind}"
    if not difference.in_replay:
        return [f"{where}: only in the flight"]
    if not difference.in_flight:
        return [f"{where}: only in the replay"]
    return [f"{where}: {name} was {then}, is {now}" for name, (then, now) in difference.fields.items()]


def _in_words(seen: "QueryResult | None") -> str:
    if seen is None:
        return "no query"
    sure = "" if seen.confidence is None else f" with {seen.confidence:.4f}"
    if seen.accepted:
        return f"place {seen.place} accepted{sure}"
    return f"refused ({seen.reason})"
