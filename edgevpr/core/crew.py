"""Several child processes that work on one job after another; none of them outlives its parent.

The children are a module run by `python -m`, which calls `serve` with the function that does a job.
"""

import json
import os
import selectors
import subprocess
import sys
from collections.abc import Callable
from types import TracebackType
from typing import Any

from edgevpr.core.child import end_with_parent, open_answers
from edgevpr.core.errors import EdgevprError


class Crew:
    """`count` children of `python -m MODULE`. Jobs and answers are anything that JSON holds. Left by `with`, all are
    killed at once: a job must leave nothing half done."""

    def __init__(self, module: str, count: int, environment: dict[str, str]) -> None:
        self._selector = selectors.DefaultSelector()
        self._idle: list[subprocess.Popen[str]] = []
        self._all: list[subprocess.Popen[str]] = []
        self._jobs: dict[int, Any] = {}
        for _ in range(count):
            # A session of its own: only the parent process is to act on Ctrl-C.
            child = subprocess.Popen(
                [sys.executable, "-m", module],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env=os.environ | environment,
                start_new_session=True,
            )
            self._all.append(child)
            self._say(child, {"parent_pid": os.getpid()})
            self._selector.register(child.stdout, selectors.EVENT_READ, child)
            self._idle.append(child)

    def __enter__(self) -> "Crew":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._selector.close()
        for child in self._all:
            child.kill()
        for child in self._all:
            child.wait()
            for pipe in (child.stdin, child.stdout):
                try:
                    pipe.close()
                except OSError:  # what it was not there to read
                    continue

    @property
    def has_idle(self) -> bool:
        """True where a child has nothing to do."""
        return bool(self._idle)

    @property
    def is_working(self) -> bool:
        """True where a child has something to do."""
        return len(self._idle) < len(self._all)

    def give(self, job: Any) -> None:
        """Give a job to a child that has nothing to do."""
        child = self._idle.pop()
        self._jobs[child.pid] = job
        self._say(child, job)

    def next_done(self) -> tuple[Any, Any]:
        """Wait for a job to be done, and return it with its answer. Raises EdgevprError where a child has died."""
        ((key, _), *_) = self._selector.select()
        child = key.data
        line = child.stdout.readline()
        if not line.endswith("\n"):
            code = child.wait()
            cause = f"it was killed by signal {-code}; perhaps memory is short" if code < 0 else f"exit code {code}"
            raise EdgevprError(
                f"A worker has ended ({cause}): run again, with fewer --workers; all that is done stays."
            )
        self._idle.append(child)
        return self._jobs.pop(child.pid), json.loads(line)

    def _say(self, child: "subprocess.Popen[str]", what: Any) -> None:
        try:
            child.stdin.write(json.dumps(what) + "\n")
            child.stdin.flush()
        except BrokenPipeError:
            pass  # it has died, which `next_done` tells


def serve(work: Callable[[Any], Any]) -> None:
    """Do one job after another in a child, until the parent ends or says no more. What a library prints does not get
    into the answers."""
    end_with_parent(json.loads(sys.stdin.readline())["parent_pid"])
    answers = open_answers()
    for line in sys.stdin:
        answers.write(json.dumps(work(json.loads(line))) + "\n")
        answers.flush()
