"""Findings of `edgevpr check` and `edgevpr doctor`: what was looked at, whether it is fine, and what to change."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from edgevpr.core.errors import EdgevprError


@dataclass(frozen=True, slots=True)
class FlightIntent:
    """The flight that is to be: whether it sends fixes (else it is a dry run), and the seconds between two queries."""

    sends_fixes: bool
    every_s: float


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was checked; `message` says what it is or, in one sentence, what is wrong with it. `changes` are
    the exact changes that put it right, such as `GPS2_TYPE=14`."""

    what: str
    ok: bool
    message: str
    changes: tuple[str, ...] = ()


def fine(what: str, message: str) -> Finding:
    """Say what a thing is that needs no change."""
    return Finding(what, True, message)


def wrong(what: str, message: str, *changes: str) -> Finding:
    """Say in a sentence what is wrong with a thing, and which changes put it right."""
    return Finding(what, False, message, changes)


def looked_at(what: str, look: Callable[[], str]) -> Finding:
    """Look at one thing: what `look` returns is fine, and what it raises for the user is wrong."""
    try:
        return fine(what, look())
    except EdgevprError as error:
        return wrong(what, str(error))
    except OSError as error:
        return wrong(what, f"{error.filename}: {error.strerror}: check the path and its permissions.")


def lines(findings: Iterable[Finding]) -> Iterator[str]:
    """Write findings for people: a line each, and below it a line for every change."""
    for finding in findings:
        yield f"{'ok   ' if finding.ok else 'WRONG'}  {finding.what:<14} {finding.message}"
        yield from (f"{'':<22}change: {change}" for change in finding.changes)
