"""Work in a child process, which may crash, hang or fill its memory without harm to the parent. The child has a time
limit and is killed when its parent ends.

The parent calls `ask_child` with the name of a module. The child is that module, run by `python -m`; it calls
`serve_parent` with the function that does the work.
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
    """Result of a child process. `code` is its exit code (0: it has answered; negative: minus the signal that ended it;
    None: it was killed at the time limit), `answer` its answer (any JSON; None: no answer), and `said` its stderr."""

    code: int | None
    answer: Any
    said: str


def ask_child(module: str, job: Any, limit_s: float) -> Ended:
    """Run `python -m MODULE` on a job (any JSON) for at most `limit_s` seconds, and return how it ended."""
    # The child gets its own session, so that only the parent process receives Ctrl-C.
    process = subprocess.Popen(
        [sys.executable, "-m", module],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",  # a library may print bytes of a damaged file
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
    """Serve one request, in the child: read the job from stdin, call `work` with it, and write the result to stdout as
    JSON. Text that a library prints goes to stderr, not into the answer."""
    request = json.load(sys.stdin)
    end_with_parent(request["parent_pid"])
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answer:
        os.dup2(2, 1)
        json.dump(work(request["job"]), answer)


def end_with_parent(parent_pid: int) -> None:
    """Make the kernel kill this process when its parent ends in any way, even if a library here is in an endless loop.
    `parent_pid` is the process id of the parent. Exits at once if the parent has ended already."""
    import ctypes  # not at the top: the parent may be a flight, which has no use for it

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:  # the parent ended before the line above
        sys.exit(1)


def last_line(ended: Ended) -> str:
    """Return the last line of a failed child's stderr (else its exit code), at most 200 characters, for a message."""
    return (ended.said.strip().splitlines() or [f"exit code {ended.code}"])[-1][:200]
