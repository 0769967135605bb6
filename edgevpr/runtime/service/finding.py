"""Findings of `edgevpr check` and `edgevpr doctor`: what was checked, whether it is fine, and what to change."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from edgevpr.core.errors import EdgevprError


@dataclass(frozen=True, slots=True)
class FlightIntent:
    """Intent of a flight, against which an autopilot is checked: `sends_fixes` (False: a dry run, which sends none) and
    `every_s`, the seconds between two queries."""

    sends_fixes: bool
    every_s: float


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check. `what`: name of what was checked. `message`: a description of it or, if it is not `ok`, one
    sentence that says what is wrong. `changes`: the exact changes that put it right, such as `GPS2_TYPE=14`."""

    what: str
    ok: bool
    message: str
    changes: tuple[str, ...] = ()


def fine(what: str, message: str) -> Finding:
    """Return a finding without anything to change; `message` describes what was checked."""
    return Finding(what, True, message)


def wrong(what: str, message: str, *changes: str) -> Finding:
    """Return a finding with something wrong; `message` says what in one sentence, and `changes` put it right."""
    return Finding(what, False, message, changes)


def judged(what: str, ok: bool, good: str, bad: str, *changes: str) -> Finding:
    """Return a fine finding with the text `good` if `ok`, else a wrong one with the text `bad` and the `changes` that
    put it right."""
    return fine(what, good) if ok else wrong(what, bad, *changes)


def looked_at(what: str, look: Callable[[], str]) -> Finding:
    """Run a check and return its finding: fine with the text that `look` returns, wrong with the error that it
    raises."""
    try:
        return fine(what, look())
    except EdgevprError as error:
        return wrong(what, str(error))
    except OSError as error:
        return wrong(what, f"{error.filename}: {error.strerror}: check the path and its permissions.")


def lines(findings: Iterable[Finding]) -> Iterator[str]:
    """Yield the findings as lines of text: one for each finding, then one for each of its changes."""
    for finding in findings:
        yield f"{'ok   ' if finding.ok else 'WRONG'}  {finding.what:<14} {finding.message}"
        yield from (f"{'':<22}change: {change}" for change in finding.changes)
