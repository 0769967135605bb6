"""Work in a child process that may crash, hang or fill the memory without harm: it has a limit of time, and never
outlives its parent.

The child is a module run by `python -m`, which calls `serve_parent` with the function that does the work.
"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

_PR_SET_PDEATHSIG = 1  # prctl(2)


@dataclass(frozen=True, slots=True)
class Ended:
    """End of a child: its exit code (0: it has an answer; below zero: minus the signal that ended it; None: it was
    killed at the limit of time), its answer, and what else was said in it."""

    code: int | None
    answer: Any
    said: str


def ask_child(module: str, job: Any, limit_s: float) -> Ended:
    """Let `python -m MODULE` work on a job (any JSON) for at most `limit_s` seconds."""
    # A session of its own: only the parent process is to act on Ctrl-C.
    process = subprocess.Popen(
        [sys.executable, "-m", module],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",  # a library may repeat what stands in a broken file
        start_new_session=True,
    )
    try:
        answer, said = process.communicate(json.dumps({"parent_pid": os.getpid(), "job": job}), timeout=limit_s)
    except subprocess.TimeoutExpired:
        return Ended(None, None, "")
    finally:
        process.kill()
        process.wait()
    try:
        return Ended(process.returncode, json.loads(answer) if process.returncode == 0 else None, said)
    except ValueError:  # a library has ended the process with exit code 0
        return Ended(1, None, said)


def serve_parent(work: Callable[[Any], Any]) -> None:
    """Do the work in the child: read the job, and print what `work` makes of it. What a library prints goes to stderr,
    and not into the answer."""
    request = json.load(sys.stdin)
    end_with_parent(request["parent_pid"])
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answer:
        os.dup2(2, 1)
        json.dump(work(request["job"]), answer)


def end_with_parent(parent_pid: int) -> None:
    """Let the kernel kill this process when its parent ends, however that ends, even while a library loops for ever."""
    import ctypes  # not at the top: the parent may be a flight, which has no use for it

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:  # it ended before the line above
        sys.exit(1)


def last_line(ended: Ended) -> str:
    """Return the last line that a failed child has said, for a message."""
    return (ended.said.strip().splitlines() or [f"exit code {ended.code}"])[-1][:200]
