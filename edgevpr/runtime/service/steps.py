"""Steps of an installation: each says what it does, or that it is so already, and a run that was broken off goes on
where it stopped."""

import os
import subprocess
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from edgevpr.core.errors import EdgevprError

_AGAIN = "correct that and run it again: what is done stays"


@dataclass(frozen=True, slots=True)
class Step:
    """One step: in words, what is so after it; `is_so` tells whether it is so already, and `do` makes it so."""

    what: str
    is_so: Callable[[], bool]
    do: Callable[[], None]


def walk(steps: Iterable[Step], dry_run: bool, say: Callable[[str], None]) -> None:
    """Take the steps that are not so already, and say each before it is taken. With `dry_run` the same is said and
    nothing done. Raises EdgevprError for the first step that fails."""
    before = os.umask(0o022)  # the service's user is to read what root writes
    try:
        for step in steps:
            is_so = step.is_so()
            say(f"{'is so' if is_so else 'to do'}  {step.what}")
            if not is_so and not dry_run:
                _take(step)
    finally:
        os.umask(before)


def _take(step: Step) -> None:
    try:
        step.do()
        os.sync()  # what another run will find so, is so after a power cut too
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        raise EdgevprError(f"{step.what}: {where}{error.strerror or error}; {_AGAIN}.") from error


def command(*words: str | Path, **environment: str) -> None:
    """Run a program of the system; raises EdgevprError with the last that it said where it fails."""
    path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"  # `su` leaves those two out
    name = Path(words[0]).name
    try:
        done = subprocess.run(
            words,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            env={**os.environ, "PATH": path, **environment},
        )
    except FileNotFoundError as error:
        raise EdgevprError(f"{name} is not on this machine; {_AGAIN}.") from error
    if done.returncode:
        lines = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]
        errors = [line for line in lines if line.startswith("ERROR: ")]  # pip's, which may go on to advise an upgrade
        said = (errors or lines or [f"exit code {done.returncode}"])[-1]
        raise EdgevprError(f"{name}: {said.removeprefix('ERROR: ').rstrip('.')}; {_AGAIN}.")
