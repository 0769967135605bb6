"""`edgevpr run` as a process of its own, looked at from outside: its log, its memory, its CPU time."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
from loopback import free_port
from mavlink_peers import AutopilotThread
from pictures import draw_texture

from edgevpr.runtime.flight.flightlog import read_log

_PATIENCE_S = 60.0
_TICK_S = 1 / os.sysconf("SC_CLK_TCK")


def write_frames(folder: Path, count: int) -> None:
    """Write pictures as a camera gives them, 640x480 in colour, as JPEG files."""
    folder.mkdir()
    for number in range(count):
        cv2.imwrite(str(folder / f"{number:04d}.jpg"), cv2.cvtColor(draw_texture(number, 480, 640), cv2.COLOR_GRAY2BGR))


def start(
    place_map: Path, source: Path | str, log: Path, *flags: str, through: Sequence[str] = (), **environment: str
) -> subprocess.Popen:
    """Start a flight, by way of the program `through` where one is named (`prlimit ...`)."""
    command = ["-m", "edgevpr", "run", "--map", place_map, "--source", source, "--log", log, *flags]
    env = {**os.environ, **environment}
    return subprocess.Popen([*through, sys.executable, *map(str, command)], stderr=subprocess.PIPE, text=True, env=env)


@contextmanager
def serve_autopilot(**how):
    """A simulated flight controller: its link, and a call that ends it and returns what it has received."""
    port = free_port()
    autopilot = AutopilotThread(f"udpin:127.0.0.1:{port}", **how)
    try:
        yield f"udpout:127.0.0.1:{port}", autopilot.finish
    finally:
        autopilot.finish()


def finish_flight(process: subprocess.Popen, code: int = 0) -> str:
    """Wait for the end of a flight, which must be with this code; return what it has said."""
    said = process.communicate(timeout=120)[1]
    assert process.returncode == code, said
    return said


@contextmanager
def open_notify_socket(folder: Path):
    """systemd's end of the socket, and the environment that names it."""
    address = str(folder / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(address)
        listening.settimeout(60)
        yield listening, {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "200000"}


def wait_for(kind: str, log: Path, process: subprocess.Popen, count: int = 1) -> dict[str, Any]:
    """The line of a kind in the flight log with this number, once it is there. Raises RuntimeError if none comes."""
    give_up_s = time.monotonic() + _PATIENCE_S
    while time.monotonic() < give_up_s:
        over = process.poll() is not None
        lines = [line for line in read_log(log) if line["kind"] == kind] if log.exists() else []
        if len(lines) >= count:
            return lines[count - 1]
        if over:
            raise RuntimeError(f"the flight has ended without a line `{kind}`: {process.communicate()[1]}")
        time.sleep(0.02)
    raise RuntimeError(f"no line `{kind}` in {log} after {_PATIENCE_S:g} s")


def read_memory_mb(pid: int | str) -> dict[str, float]:
    """VmHWM (the largest resident set so far), VmRSS, Pss, ... of a process, MB of 10^6 bytes; {} once it has ended."""
    try:
        text = Path(f"/proc/{pid}/status").read_text() + Path(f"/proc/{pid}/smaps_rollup").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return {}
    words = (line.split() for line in text.splitlines() if line.endswith(" kB"))
    return {name.rstrip(":"): int(kib) * 1024 / 1e6 for name, kib, _ in words}


def watch_memory(process: subprocess.Popen, every_s: float = 0.05) -> tuple[dict[str, float], str]:
    """Until the flight ends: (the largest value of each figure of `read_memory_mb`, the names of all files mapped)."""
    largest: dict[str, float] = {}
    mapped = ""
    while process.poll() is None:
        for name, value in read_memory_mb(process.pid).items():
            largest[name] = max(value, largest.get(name, 0.0))
        mapped = Path(f"/proc/{process.pid}/maps").read_text() or mapped
        time.sleep(every_s)
    return largest, mapped


def read_cpu_s(pid: int) -> float:
    """CPU-seconds of all threads of a process so far, from /proc/PID/stat, to 10 ms."""
    after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(after_name[11]) + int(after_name[12])) * _TICK_S
