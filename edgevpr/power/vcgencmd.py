"""`vcgencmd`, the Raspberry Pi's program for asking its firmware. Every question starts a process: milliseconds."""

import subprocess
from pathlib import Path


def find(root: Path) -> Path | None:
    """Find the program; None on another board. Older systems keep it in /opt/vc."""
    places = (root / "usr/bin/vcgencmd", root / "opt/vc/bin/vcgencmd")
    return next((place for place in places if place.exists()), None)


def ask(program: Path, question: str) -> str:
    """Ask the firmware and return its answer. Raises OSError where the program fails or does not answer for two
    seconds."""
    try:
        answer = subprocess.run([program, question], capture_output=True, timeout=2, check=True)
    except subprocess.CalledProcessError as error:
        words = error.stderr.decode(errors="replace").strip()[:80]
        raise OSError(words or f"it ended with code {error.returncode}") from None
    except subprocess.TimeoutExpired:
        raise OSError("no answer for two seconds") from None
    return answer.stdout.decode(errors="replace")
