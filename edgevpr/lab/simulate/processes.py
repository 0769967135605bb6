"""Commands of edgevpr as processes of their own, beside a simulated autopilot that is one too: for `demo` and
`mission`."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from edgevpr.core.errors import EdgevprError


@contextmanager
def autopilot_process(*flags: object, said: TextIO | None = None) -> Iterator[str]:
    """Run `edgevpr simulate autopilot` with the given flags at a free port, and yield the address to reach it by. What
    it says goes to `said` (None: stderr)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    with started("simulate", "autopilot", "--link", f"udpin:{address}", *flags, said=said):
        yield f"udpout:{address}"


@contextmanager
def started(*words: object, said: TextIO | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command of edgevpr beside the body of `with`, and end it there."""
    with subprocess.Popen(_command(*words), stdout=subprocess.DEVNULL, stderr=said) as process:
        try:
            yield process
        finally:
            process.terminate()


def run_to_end(*words: object) -> None:
    """Run a command of edgevpr. Raises EdgevprError if it fails."""
    done = subprocess.run(_command(*words), stdout=subprocess.DEVNULL)
    if done.returncode:
        said = f"`{' '.join(done.args[2:])}` ended with exit code {done.returncode}"
        raise EdgevprError(f"{said}: see what it said above.")


def _command(*words: object) -> list[str]:
    return [sys.executable, "-m", "edgevpr", *map(str, words)]
