"""The world around the machine: a camera, a flight controller and a ground station, which can be taken away."""

import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path

from pymavlink import mavutil

_HERE = Path(__file__).parent
_TRACK_S, _STEP_DEG = 3600, 0.00015  # of latitude, 17 m a second: every picture is a place of its own
RATE_HZ = 2.0  # of the camera


def make_flight(folder: Path) -> None:
    """Generate a flight and maps of it, unless that is done. The camera will show the very pictures of the map: it is
    the service that is tried here. Of all techniques `hog` takes the least of an emulated processor; with `cohog` a
    start is slow (slow.gpkg)."""
    if (folder / "valley.gpkg").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    _edgevpr("simulate", "flight", folder)
    for technique, name in (("cohog", "slow"), ("hog", "valley")):
        unfinished = folder / "unfinished.gpkg"
        _edgevpr("map", "build", unfinished, "--images", folder / "images", "--technique", technique, "--no-calibrate")
        unfinished.rename(folder / f"{name}.gpkg")


def write_track(path: Path) -> Path:
    """Write a straight flight of an hour, for one that learns."""
    start = datetime(2026, 2, 14, tzinfo=timezone.utc)
    lines = [
        f"{second},{-35.36 + second * _STEP_DEG:.6f},149.16,600,{(start + timedelta(seconds=second)).isoformat()}"
        for second in range(_TRACK_S)
    ]
    path.write_text("file,lat,lon,alt,time\n" + "\n".join(lines) + "\n")
    return path


class Ground:
    """A ground station: pymavlink at a UDP port, which keeps what edgevpr tells it: `texts` with their times, and when
    accepted matches and queries were told, by this machine's monotonic clock."""

    def __init__(self) -> None:
        self.port = _free_port(socket.SOCK_DGRAM)
        self.texts: list[tuple[float, str]] = []
        self.matches_s: list[float] = []
        self.queries_s: list[float] = []
        self._link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{self.port}", source_system=255)
        self._on = True
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        while self._on:
            message = self._link.recv_match(blocking=True, timeout=0.2)
            if message is None or message.get_srcComponent() != 197:
                continue
            now_s = time.monotonic()
            if message.get_type() == "STATUSTEXT":
                self.texts.append((now_s, message.text))
            elif message.get_type() == "NAMED_VALUE_INT" and message.name == "vpr_place":
                self.matches_s.append(now_s)
            elif message.get_type() == "NAMED_VALUE_FLOAT" and message.name == "vpr_cpu":
                self.queries_s.append(now_s)

    def told_since(self, begin_s: float) -> list[str]:
        """Return the texts since then, each once, in order."""
        return list(dict.fromkeys(text for t_s, text in list(self.texts) if t_s >= begin_s))

    def close(self) -> None:
        self._on = False
        self._thread.join()
        self._link.close()


class World:
    """Camera, flight controller and ground station of one flight."""

    def __init__(self, flight: Path) -> None:
        self.flight = flight
        self.ground = Ground()
        self.camera_port = _free_port(socket.SOCK_STREAM)
        self.autopilot_port = _free_port(socket.SOCK_DGRAM)
        self.camera: subprocess.Popen | None = None
        self.autopilot: subprocess.Popen | None = None

    @property
    def ports(self) -> dict[str, int]:
        """Return the ports of the flight controller and of the ground station, by the keys of the configuration."""
        return {"link": self.autopilot_port, "ground": self.ground.port}

    def start_camera(self) -> None:
        words = _HERE / "camera.py", self.flight / "images", self.camera_port, RATE_HZ
        self.camera = subprocess.Popen([sys.executable, *map(str, words)])

    def start_autopilot(self, *words: object) -> None:
        link = f"udpin:127.0.0.1:{self.autopilot_port}"
        command = [sys.executable, "-m", "edgevpr", "simulate", "autopilot", "--link", link, *map(str, words)]
        self.autopilot = subprocess.Popen(command, stdout=subprocess.DEVNULL)

    def kill(self, process: subprocess.Popen) -> None:
        """Take one away without a word."""
        process.kill()
        process.wait()

    def close(self) -> None:
        for process in filter(None, (self.camera, self.autopilot)):
            self.kill(process)
        self.ground.close()


def wait_until(is_so: Callable[[], object], limit_s: float, what: str, look_s: float = 0.05) -> float:
    """Wait until something is so, with a look every `look_s`; return how long it took. Raises RuntimeError where it
    does not come."""
    begin_s = time.monotonic()
    while not is_so():
        if time.monotonic() - begin_s > limit_s:
            raise RuntimeError(f"{what}: not within {limit_s:g} s")
        time.sleep(look_s)
    return time.monotonic() - begin_s


def _free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _edgevpr(*words: object) -> None:
    subprocess.run(["nice", sys.executable, "-m", "edgevpr", *map(str, words)], check=True, capture_output=True)
