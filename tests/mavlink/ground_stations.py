"""Real ground stations and routers.

`make test` puts MAVProxy and MAVSDK into the folder `clients` of the virtual environment; EDGEVPR_CLIENTS names
another."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from loopback import PATIENCE_S, wait_until

CLIENTS = Path(os.environ.get("EDGEVPR_CLIENTS") or Path(sys.prefix) / "clients")


class Station:
    """A ground station's program, with what it has said so far."""

    def __init__(self, command: list[str], folder: Path) -> None:
        self.said: list[str] = []
        self._process = subprocess.Popen(
            [sys.executable, *command],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(CLIENTS), "HOME": str(folder), "TERM": "dumb"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._thread = threading.Thread(target=lambda: self.said.extend(iter(self._process.stdout.readline, "")))
        self._thread.start()

    def __enter__(self) -> "Station":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        self._thread.join()
        self._process.stdin.close()
        self._process.stdout.close()

    def wait_for(self, *words: str) -> str:
        """Wait for a line with all these words, and return it."""

        def find_line():
            assert self._process.poll() is None, f"it has ended:\n{''.join(self.said)}"
            return next((line for line in self.said if all(word in line for word in words)), None)

        try:
            return wait_until(find_line, " ".join(words), every_s=0.2)
        except AssertionError as error:
            raise AssertionError(f"{error}; it said:\n{''.join(self.said)}") from None

    def wait_for_end(self) -> int:
        """Wait until it ends by itself; return its exit code."""
        return self._process.wait(PATIENCE_S)


def start_mavsdk_example(port: int, folder: Path) -> Station:
    """Start the example of MAVSDK beside edgevpr."""
    _require("mavsdk")
    return Station([str(Path(__file__).parents[2] / "examples" / "mavsdk_beside.py"), str(port)], folder)


def start_mavproxy(folder: Path, *flags: str) -> Station:
    """Start MAVProxy with these flags, without windows."""
    _require("MAVProxy")
    quiet = ["--default-modules=link", f"--logfile={folder / 'mavproxy.tlog'}"]
    return Station([str(CLIENTS / "bin" / "mavproxy.py"), *flags, *quiet], folder)


def _require(package: str) -> None:
    if not (CLIENTS / package).is_dir():
        pytest.skip(f"{package} is not in {CLIENTS}: `make test` puts it there, where it can be had")
