"""Work in a child process that may crash, hang or fill the memory without harm: it has a limit of time, and never
outlives its parent.

The child is a module run by `python -m`. It reads its job with `job_of_parent` and prints its answer.
"""

import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

_PR_SET_PDEATHSIG = 1  # prctl(2)


@dataclass(frozen=True, slots=True)
class Ended:
    """End of a child: its exit code (below zero: minus the signal that ended it; None: it was killed at the limit of
    time), its answer, and what else it said."""

    code: int | None
    answer: str
    said: str


def ask_child(module: str, job: Any, limit_s: float) -> Ended:
    """Let `python -m MODULE` work on a job (any JSON) for at most `limit_s` seconds."""
    # A session of its own: only the parent process is to act on Ctrl-C.
    process = subprocess.Popen(
        [sys.executable, "-m", module],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        answer, said = process.communicate(json.dumps({"parent_pid": os.getpid(), "job": job}), timeout=limit_s)
    except subprocess.TimeoutExpired:
        return Ended(None, "", "")
    finally:
        process.kill()
        process.wait()
    return Ended(process.returncode, answer, said)


def job_of_parent() -> Any:
    """Read the job in the child, and tie its life to its parent's: when that ends, however it ends, the kernel kills
    the child, even in an endless loop of a library."""
    import ctypes  # not at the top: the parent may be a flight, which has no use for it

    asked = json.load(sys.stdin)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != asked["parent_pid"]:  # it ended before the line above
        sys.exit(1)
    return asked["job"]


def last_line(ended: Ended) -> str:
    """Return the last line that a failed child has said, for a message."""
    return (ended.said.strip().splitlines() or [f"exit code {ended.code}"])[-1][:200]
