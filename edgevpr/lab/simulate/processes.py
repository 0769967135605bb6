"""Commands of edgevpr as processes of their own, next to a simulated autopilot that is one too: for `demo` and
`mission`."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from edgevpr.core.errors import EdgevprError


@contextmanager
def autopilot_process(*flags: object, output: TextIO | None = None) -> Iterator[str]:
    """Run `edgevpr simulate autopilot` with the given flags at a free port, and yield the address to reach it by. Its
    messages go to `output` (None: stderr)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    command = _command("simulate", "autopilot", "--link", f"udpin:{address}", *flags)
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=output) as process:
        try:
            yield f"udpout:{address}"
        finally:
            process.terminate()


def run_to_end(*words: object, output: TextIO | None = None) -> None:
    """Run a command of edgevpr. Its messages go to `output` (None: stderr). Raises EdgevprError if it fails."""
    done = subprocess.run(_command(*words), stdout=subprocess.DEVNULL, stderr=output)
    if done.returncode:
        where = f"in {output.name}" if output else "above"
        raise EdgevprError(
            f"`{' '.join(done.args[2:])}` ended with exit code {done.returncode}: see its message {where}."
        )


def _command(*words: object) -> list[str]:
    return [sys.executable, "-m", "edgevpr", *map(str, words)]
