"""An hour of flight, looked at from outside: `make soak MINUTES=60` writes benchmarks/results/soak.md and soak.json,
and ends with code 1 where memory, descriptors or threads grow.

python benchmarks/soak.py [--minutes M]

A real `edgevpr run` flies with a camera that speaks RTSP, an autopilot over UDP, a second link, a status file, a
flight log that is limited to 1 MB and a tlog. Again and again the camera or the autopilot goes away and comes back, the
second link's other end closes, and readers of the status come and leave.
"""

import argparse
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, suppress
from itertools import count
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory

import base
import psutil
import yaml
from base import Row
from rtsp_camera import free_port
from soak_page import page, verdict
from soak_world import FOV_DEG, Autopilot, FilmCamera, make_world

from edgevpr.core.errors import EdgevprError
from edgevpr.runtime.flight.flightlog import read_log
from edgevpr.runtime.flight.status import read_status

LOG_MB = 1.0
_RADIUS_M = 110.0  # of the lap
_CYCLE_S = 300.0  # in which everything happens once
_AFTER = 0.06  # of a cycle: so long after its return what was away may still show
_EVERY_S = 5.0  # from one look at the process to the next
_PATIENCE_S = 60.0
_TURN_S = 0.1
# Something that is away from one part of a cycle to another: its name, those two, and how it goes and comes.
Absence = tuple[str, float, float, Callable[[], None], Callable[[], None]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    minutes = parser.parse_args().minutes
    with TemporaryDirectory(prefix="edgevpr-soak-") as folder:
        found = base.made_by() | run(Path(folder), 60 * minutes, _EVERY_S)
    base.write("soak", found, page(found))
    sys.exit("\n".join(f"soak: {each}" for each in verdict(found)) or None)


def run(folder: Path, lasts_s: float, every_s: float, radius_m: float = _RADIUS_M) -> Row:
    """Fly for so long and return what was seen. Raises RuntimeError where the flight does not start, or ends."""
    world = make_world(folder, radius_m)
    lens = ("--camera", "nadir", "--fov-deg", FOV_DEG)
    images = ("--images", world.places / "images", "--technique", "cohog", "--no-calibrate")
    base.edgevpr("map", "build", folder / "map.gpkg", *images, *lens)
    with ExitStack() as stack:
        camera = FilmCamera(world, folder)
        stack.callback(camera.close)
        port = free_port()
        autopilot = Autopilot(f"udpin:127.0.0.1:{port}", world, camera.start_s)
        stack.callback(autopilot.close)
        ground = _Ground()
        stack.callback(ground.close)
        flight = Flight(folder, camera.uri, port, ground.port)
        stack.callback(flight.end)
        flight.wait_until_it_flies()
        watch = _Watch(flight, ground, min(_CYCLE_S, lasts_s), every_s)
        samples = watch.look_until(lasts_s, _absences(camera, autopilot, ground))
        code, said = flight.end()
    ends = [line for line in read_log(flight.log) if line["kind"] == "end"]
    return {
        "samples": samples,
        "events": watch.events,
        "statuses": watch.statuses,
        "exit_code": code,
        "tracebacks": said.count("Traceback"),
        "log_limit_mb": LOG_MB,
        "end": {name: value for name, value in (ends[-1] if ends else {}).items() if isinstance(value, int | float)},
    }


class Flight:
    """`edgevpr run` as a process of its own, with its files in `folder`."""

    def __init__(self, folder: Path, uri: str, port: int, ground_port: int) -> None:
        self.log, self.tlog, self.status = folder / "flight.jsonl", folder / "flight.tlog", folder / "status.json"
        config = folder / "config.yaml"
        self._stderr = folder / "said.txt"
        settings = {
            "map": str(folder / "map.gpkg"),
            "source": {"uri": uri, "camera": "nadir", "fov_deg": FOV_DEG, "rate_hz": 2.0},
            "mavlink": {"link": f"udpout:127.0.0.1:{port}", "ground": f"udpout:127.0.0.1:{ground_port}"},
            "log": {"path": str(self.log), "max_mb": LOG_MB, "tlog": str(self.tlog)},
            "status": {"file": str(self.status)},
        }
        config.write_text(yaml.safe_dump(settings))
        with open(self._stderr, "w") as stderr:
            command = [sys.executable, "-m", "edgevpr", "run", "--config", config]
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=stderr)

    def wait_until_it_flies(self) -> None:
        """Wait for the first query. Raises RuntimeError where none comes."""
        give_up_s = time.monotonic() + _PATIENCE_S
        while not (self.log.exists() and any(line["kind"] == "query" for line in read_log(self.log))):
            if self.process.poll() is not None or time.monotonic() > give_up_s:
                raise RuntimeError(f"the flight does not begin: {self._stderr.read_text()}")
            time.sleep(0.05)

    def end(self) -> tuple[int, str]:
        """End the flight, and return its exit code and what it said."""
        if self.process.poll() is None:
            self.process.terminate()
        return self.process.wait(_PATIENCE_S), self._stderr.read_text()


class _Ground:
    """The other end of the second link, which reads all it is sent, and closes and opens again at one port."""

    def __init__(self) -> None:
        self.port = free_port()
        self.open()

    def open(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", self.port))
        self._socket.setblocking(False)

    def read(self) -> None:
        with suppress(OSError):  # there is no more, or it is closed
            while self._socket.recv(65_536):
                pass

    def close(self) -> None:
        self._socket.close()


class _Watch:
    """Looks at the flight every few seconds, and lets things go away and come back. `events` counts these by name."""

    def __init__(self, flight: Flight, ground: _Ground, cycle_s: float, every_s: float) -> None:
        self.events: Counter[str] = Counter()
        self.statuses = 0
        self._flight, self._ground, self._cycle_s, self._every_s = flight, ground, cycle_s, every_s
        self._process = psutil.Process(flight.process.pid)
        self._away: dict[str, Callable[[], None]] = {}  # what is away, and how it comes back
        self._returned_s = float("-inf")

    def look_until(self, lasts_s: float, absences: list[Absence]) -> list[Row]:
        """Return a sample for each look. Raises RuntimeError where the flight ends before its time."""
        steps = sorted(
            [(each[1], each) for each in absences] + [(each[2], each) for each in absences], key=itemgetter(0)
        )
        timetable = (((cycle + part) * self._cycle_s, each) for cycle in count() for part, each in steps)
        due_s, absence = next(timetable)
        begin_s, samples = time.monotonic(), []
        while (t_s := time.monotonic() - begin_s) < lasts_s:
            while due_s <= t_s:  # all of it and in its order, however late
                self._turn(absence, t_s)
                due_s, absence = next(timetable)
            if t_s < len(samples) * self._every_s:
                time.sleep(_TURN_S)
                continue
            samples.append(self._sample(t_s))
            self._ground.read()
            if self._away:  # else a reader that has just left would be counted while all is there
                with suppress(EdgevprError):  # counted as none
                    self.statuses += read_status(self._flight.status) is not None
        for come in self._away.values():
            come()
        return samples

    def _turn(self, absence: Absence, t_s: float) -> None:
        """Let what is there go, or what is away come back."""
        name, _, _, go, come = absence
        if name in self._away:
            self._away.pop(name)()
            self._returned_s = t_s
        else:
            go()
            self._away[name] = come
            self.events[name] += 1

    def _sample(self, t_s: float) -> Row:
        try:
            with self._process.oneshot():
                memory, cpu = self._process.memory_info(), self._process.cpu_times()
                threads = self._process.num_threads()
            descriptors = 0
            for _ in range(3):  # a log that changes its file has one less for a moment
                descriptors = max(descriptors, self._process.num_fds())
                time.sleep(_TURN_S)
        except psutil.Error as error:
            raise RuntimeError(f"the flight has ended after {t_s:.0f} s: {self._flight.end()}") from error
        log_bytes = sum(path.stat().st_size for path in self._flight.log.parent.glob("flight*.jsonl"))
        tlog_bytes = self._flight.tlog.stat().st_size if self._flight.tlog.exists() else 0
        return {
            "t_s": round(t_s, 2),
            "rss_mb": memory.rss / 1e6,
            "descriptors": descriptors,
            "threads": threads,
            "cpu_s": cpu.user + cpu.system,
            "log_mb": log_bytes / 1e6,
            "tlog_mb": tlog_bytes / 1e6,
            "away": ", ".join(self._away),
            "is_calm": not self._away and t_s - self._returned_s >= _AFTER * self._cycle_s,
        }


def _absences(camera: FilmCamera, autopilot: Autopilot, ground: _Ground) -> list[Absence]:
    return [
        ("camera pulled out", 0.27, 0.33, camera.pull_out, camera.plug_in),
        ("autopilot killed", 0.42, 0.49, autopilot.kill, autopilot.start),
        ("camera silent", 0.58, 0.63, lambda: camera.fall_silent(True), lambda: camera.fall_silent(False)),
        ("autopilot frozen", 0.73, 0.78, lambda: autopilot.freeze(True), lambda: autopilot.freeze(False)),
        ("ground station closed", 0.88, 0.92, ground.close, ground.open),
    ]


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
