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
from typing import Any

from edgevpr.core.errors import EdgevprError

_PR_SET_PDEATHSIG = 1  # prctl(2)


def ask_child(module: str, job: Any, limit_s: float, what: str) -> Any:
    """Run `python -m MODULE` on a job (any JSON) for at most `limit_s` seconds, and return its answer (any JSON).

    Raises EdgevprError if the child takes longer or crashes, and for an error that the work itself raised. `what` names
    the work at the beginning of the message, such as "Trying hog".
    """
    with subprocess.Popen(
        [sys.executable, "-m", module],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",  # a library may print bytes of a damaged file
        start_new_session=True,  # so that only the parent process receives Ctrl-C
    ) as process:
        try:
            out, err = process.communicate(json.dumps({"parent_pid": os.getpid(), "job": job}), limit_s)
        except subprocess.TimeoutExpired:
            process.kill()
            raise EdgevprError(f"{what} took longer than {limit_s:g} s: it has no end, or is too slow here.") from None
        except BaseException:
            process.kill()
            raise
    if process.returncode < 0:
        hint = "memory ran out" if process.returncode == -signal.SIGKILL else "a library does not suit this processor"
        raise EdgevprError(f"{what} was ended by {signal.Signals(-process.returncode).name}: {hint}.")
    try:
        reply = json.loads(out)
    except ValueError:  # it failed, or a library has ended it
        why = (err.strip().splitlines() or [f"exit code {process.returncode}"])[-1][:200]
        raise EdgevprError(f"{what} failed ({why}): install edgevpr and its packages again.") from None
    if reply["problem"]:
        raise EdgevprError(reply["problem"])
    return reply["answer"]


def serve_parent(work: Callable[[Any], Any]) -> None:
    """Serve one request, in the child: read the job from stdin, call `work` with it, and write its result, or the
    EdgevprError that it raises, to stdout as JSON. Text that a library prints goes to stderr, not into the answer."""
    request = json.load(sys.stdin)
    end_with_parent(request["parent_pid"])
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as reply:
        os.dup2(2, 1)
        answer, problem = None, None
        try:
            answer = work(request["job"])
        except EdgevprError as error:
            problem = str(error)
        json.dump({"answer": answer, "problem": problem}, reply)


def end_with_parent(parent_pid: int) -> None:
    """Make the kernel kill this process when its parent ends in any way, even if a library here is in an endless loop.
    `parent_pid` is the process id of the parent. Exits at once if the parent has ended already."""
    import ctypes  # not at the top: the parent may be a flight, which has no use for it

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:  # the parent ended before the line above
        sys.exit(1)
