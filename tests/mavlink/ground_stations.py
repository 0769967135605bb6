"""Real ground stations at the end of the way that a companion's messages take: through the autopilot.

`make test` puts MAVProxy and MAVSDK into the folder `clients` of the virtual environment; EDGEVPR_CLIENTS names
another.
"""

import os
import select
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import pytest
from loopback import PATIENCE_S, wait_until

from edgevpr.mavlink.wire import PacketReader

CLIENTS = Path(os.environ.get("EDGEVPR_CLIENTS") or Path(sys.prefix) / "clients")
# ArduPilot passes these of a companion's messages on to the ground, among others.
PASSED_ON = {"HEARTBEAT", "STATUSTEXT", "NAMED_VALUE_FLOAT", "NAMED_VALUE_INT"}
CHUNK = 65_536


class Router:
    """The autopilot as a router: what an `autopilot` that listens at that UDP port and a companion at `companion_port`
    say to each other, and what of it reaches a ground station that listens at the port `ground`, and back."""

    def __init__(self, autopilot: int, ground: int) -> None:
        self._companion = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._companion.bind(("127.0.0.1", 0))
        self.companion_port = self._companion.getsockname()[1]
        self._to_companion: tuple[str, int] | None = None
        self._autopilot, self._ground = _connected(autopilot), _connected(ground)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._route, daemon=True)

    def __enter__(self) -> "Router":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        for each in (self._companion, self._autopilot, self._ground):
            each.close()

    def _route(self) -> None:
        receiver, has_autopilot = PacketReader(), False
        while not self._stop.is_set():
            if not has_autopilot:
                self._pass(b"\n", self._autopilot)  # it listens, and speaks to who has spoken
            for ready in select.select([self._companion, self._autopilot, self._ground], [], [], 0.1)[0]:
                try:
                    # Without waiting: the error that made it ready may have gone to a `send` meanwhile.
                    data, sender = ready.recvfrom(CHUNK, socket.MSG_DONTWAIT)
                except (ConnectionRefusedError, BlockingIOError):  # the ground station is not there yet, or has ended
                    continue
                if ready is self._companion:
                    self._to_companion = sender
                    self._pass(data, self._autopilot)
                    if any(message.get_type() in PASSED_ON for message in receiver.feed(data)):
                        self._pass(data, self._ground)
                    continue
                has_autopilot = has_autopilot or ready is self._autopilot
                self._pass(data, self._ground if ready is self._autopilot else self._autopilot)
                if self._to_companion:
                    self._companion.sendto(data, self._to_companion)

    def _pass(self, data: bytes, to: socket.socket) -> None:
        with suppress(ConnectionRefusedError):
            to.send(data)


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

        def found():
            assert self._process.poll() is None, f"it has ended:\n{''.join(self.said)}"
            return next((line for line in self.said if all(word in line for word in words)), None)

        try:
            return wait_until(found, " ".join(words), every_s=0.2)
        except AssertionError as error:
            raise AssertionError(f"{error}; it said:\n{''.join(self.said)}") from None

    def wait_for_end(self) -> int:
        """Wait until it ends by itself; return its exit code."""
        return self._process.wait(PATIENCE_S)


def mavsdk_example(port: int, folder: Path) -> Station:
    """Start the example of MAVSDK beside edgevpr."""
    _need("mavsdk")
    return Station([str(Path(__file__).parents[2] / "examples" / "mavsdk_beside.py"), str(port)], folder)


def mavproxy_with(folder: Path, *flags: str) -> Station:
    """Start MAVProxy with these flags, without windows."""
    _need("MAVProxy")
    quiet = ["--default-modules=link", f"--logfile={folder / 'mavproxy.tlog'}"]
    return Station([str(CLIENTS / "bin" / "mavproxy.py"), *flags, *quiet], folder)


def _need(package: str) -> None:
    if not (CLIENTS / package).is_dir():
        pytest.skip(f"{package} is not in {CLIENTS}: `make test` puts it there, where it can be had")


def _connected(port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.connect(("127.0.0.1", port))
    return sock
