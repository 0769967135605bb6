"""Child processes that end with their parent."""

import os
import signal
import sys

_PR_SET_PDEATHSIG = 1  # prctl(2)


def end_with_parent(parent_pid: int) -> None:
    """Make the kernel kill this process when its parent ends in any way, even if a library here is in an endless loop.
    `parent_pid` is the process id of the parent. Exits at once if the parent has ended already."""
    import ctypes  # not at the top: the parent may be a flight, which has no use for it

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:  # the parent ended before the line above
        sys.exit(1)
