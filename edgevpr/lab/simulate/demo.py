"""The demonstration: two generated flights, and the real commands between them, each in a process of its own."""

import json
import logging
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgevpr.core.errors import EdgevprError
from edgevpr.core.text import progress
from edgevpr.lab.simulate.camera import lit
from edgevpr.lab.simulate.generated import SCENE_DEPTH_M, SCENE_WIDTH_M, later_flight, mapping_flight, write_flight
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.lab.simulate.outcome import RIGHT_M, FlightOutcome, outcome, read_answers
from edgevpr.runtime.flight.flightlog import read_log
from edgevpr.runtime.flight.wholeflight import flight_of

_SEED = 1
_RATE_HZ = 5.0
_CAMERA = ("--camera", "nadir", "--fov-deg", 66)  # that of the generated flights
_END_TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoSummary:
    """Results of the demonstration. `costs` are means of a query under the names of the flight log; `messages` counts
    what the simulated flight controller decoded, by name."""

    places: int
    outcome: FlightOutcome
    costs: dict[str, float]
    used_mah: float
    marginal_mah: float
    messages: dict[str, int]
    fixes_accepted: int
    fixes_denied: int
    wall_s: float
    picture: Path

    def __str__(self) -> str:
        got, cost = self.outcome, self.costs
        off_map = got.queries - got.on_map
        median_m, most_m, largest_m = got.errors_m
        messages = ", ".join(f"{name} {count}" for name, count in sorted(self.messages.items()))
        return f"""
places            {self.places} in the map
queries           {got.queries}: {got.on_map} over the map, {off_map} beyond it
recall@1          {got.recall_at_1:.2f} of those over the map (best place within {RIGHT_M:g} m)
accepted          {got.accepted}, {got.accepted_wrong} of them wrong
rejected          {got.queries - got.accepted}, among them {got.off_map_rejected} of the {off_map} beyond the map
position error    median {median_m:.1f} m, 90 % within {most_m:.1f} m, largest {largest_m:.1f} m \
(of the accepted; places are 21 m apart)
a query           {1000 * cost["cpu_s"]:.0f} ms of CPU (encode {1000 * cost["t_encode_s"]:.0f} ms, \
match {1000 * cost["t_match_s"]:.0f} ms), {cost["rss_mb"]:.0f} MB of RAM
battery           {self.used_mah:.3f} mAh, {self.marginal_mah:.3f} mAh of them for recognising
flight controller {self.fixes_accepted} position fixes accepted, {self.fixes_denied} denied
  it received     {messages}
time              {self.wall_s:.0f} s
picture           {self.picture}"""


def run_demo(folder: str | Path) -> DemoSummary:
    """Generate both flights, map the first one, fly the second one against a simulated flight controller.

    Leaves in `folder`: flight-1/ and flight-2/ (images, positions.csv), map.gpkg, flight.jsonl and demo.png.
    Raises EdgevprError where a part of it fails or matplotlib is not installed.
    """
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # its messages about fonts are of no use here
    try:
        from edgevpr.lab.simulate.picture import DemoPicture
    except ModuleNotFoundError as error:
        raise EdgevprError(
            f"The demo draws a picture, but {error.name} is not installed: pip install 'edgevpr[plots]'."
        ) from error
    begin_s = time.monotonic()
    folder = Path(folder)
    log_path, picture_path = folder / "flight.jsonl", folder / "demo.png"
    first, second = folder / "flight-1", folder / "flight-2"
    for old in (*folder.glob("map.gpkg*"), log_path, picture_path):
        old.unlink(missing_ok=True)

    scene = make_scene(_SEED, SCENE_WIDTH_M, SCENE_DEPTH_M)
    mapping, later = mapping_flight(_SEED), later_flight(_SEED)
    for path, flight, label in ((first, mapping, "flight 1, to map     "), (second, later, "flight 2, hours later")):
        for _ in progress(write_flight(path, scene, flight), len(flight.poses), label):
            pass
    seen = _flown(folder, len(later.poses))

    answers = read_answers(log_path, first / "images", second / "images")
    got = outcome(answers)
    DemoPicture(answers, mapping, first / "images", second / "images").draw(
        picture_path,
        lit(scene, mapping.light, mapping.seed),
        f"{len(mapping.poses)} places, {got.queries} queries   ·   recall@1 {got.recall_at_1:.2f}   ·   "
        f"{got.accepted} accepted, {got.accepted_wrong} of them wrong   ·   "
        f"position error {got.errors_m[0]:.1f} m (median)",
    )
    lines = list(flight_of(log_path))
    costs = [line["costs"] for line in lines if line["kind"] == "query"]
    return DemoSummary(
        places=len(mapping.poses),
        outcome=got,
        costs={name: sum(cost[name] for cost in costs) / len(costs) for name in costs[0]},
        used_mah=lines[-1]["used_mah"],
        marginal_mah=lines[-1]["marginal_mah"],
        messages=seen["messages"],
        fixes_accepted=seen["fixes_accepted"],
        fixes_denied=seen["fixes_denied"],
        wall_s=time.monotonic() - begin_s,
        picture=picture_path,
    )


def _flown(folder: Path, queries: int) -> dict[str, Any]:
    """Map the first flight of a demonstration and fly the second one; return what the flight controller saw."""
    map_path, log_path, port = folder / "map.gpkg", folder / "flight.jsonl", _free_udp_port()
    first, second = folder / "flight-1" / "images", folder / "flight-2" / "images"
    # The flight controller is started first: it listens long before the map is built.
    with _edgevpr("simulate", "autopilot", "--link", f"udpin:127.0.0.1:{port}", "--json") as autopilot:
        build = ("map", "build", map_path, "--images", first, *_CAMERA, "--technique", "cohog", "--no-calibrate")
        with _edgevpr(*build) as building:
            _output(building)
        flags = ("--link", f"udpout:127.0.0.1:{port}", "--log", log_path, "--rate-hz", _RATE_HZ)
        with _edgevpr("run", "--map", map_path, "--source", second, *_CAMERA, *flags) as flying:
            for _ in progress(_queries(log_path, flying), queries, "flying"):
                pass
            _output(flying)
        autopilot.terminate()
        seen: dict[str, Any] = json.loads(_output(autopilot))
    return seen


def _free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


@contextmanager
def _edgevpr(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Run the real program in a process of its own, which ends with the block at the latest."""
    command = [sys.executable, "-m", "edgevpr", *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    with process:
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(_END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()


def _output(process: subprocess.Popen[str]) -> str:
    """Return everything that a process writes until its end. Raises EdgevprError where it fails."""
    output, _ = process.communicate()
    if process.returncode:
        command = " ".join(process.args[2:]) if isinstance(process.args, list) else process.args
        raise EdgevprError(f"`{command!s}` ended with exit code {process.returncode}: see what it said above.")
    return output


def _queries(log_path: Path, flying: subprocess.Popen[str]) -> Iterator[int]:
    """Count the queries in the growing flight log, yielding each number, until the flight ends."""
    seen, ended = 0, False
    while not ended:
        ended = flying.poll() is not None
        done = sum(line["kind"] == "query" for line in read_log(log_path)) if log_path.exists() else 0
        yield from range(seen, done)
        seen = done
        time.sleep(0.1)
