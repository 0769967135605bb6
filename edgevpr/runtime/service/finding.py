"""Findings of `edgevpr check` and `edgevpr doctor`: what was looked at, whether it is fine, and what to change."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from edgevpr.core.errors import EdgevprError


@dataclass(frozen=True, slots=True)
class Plan:
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


def looked_at(what: str, look: Callable[[], str]) -> Finding:
    """Look at one thing: what `look` returns is fine, and what it raises for the user is wrong."""
    try:
        return Finding(what, True, look())
    except EdgevprError as error:
        return Finding(what, False, str(error))
    except OSError as error:
        return Finding(what, False, f"{error.filename}: {error.strerror}: check the path and its permissions.")


def sentence(words: str) -> str:
    """Make a sentence of a reason in a few words."""
    return f"{words[0].upper()}{words[1:]}."


def lines(findings: list[Finding]) -> Iterator[str]:
    """Write findings for people: a line each, and below it a line for every change."""
    for finding in findings:
        yield f"{'ok   ' if finding.ok else 'WRONG'}  {finding.what:<14} {finding.message}"
        yield from (f"{'':<22}change: {change}" for change in finding.changes)
