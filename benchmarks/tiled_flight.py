"""Flights over a folder of a hundred tiles of ten thousand places each, most of them not in RAM: `python
benchmarks/tiled_flight.py` writes benchmarks/results/tiled_flight.md, .json and .jpg.

A real `edgevpr run` flies from corner to corner, at 40 m/s and one query in two seconds, beside a simulated autopilot
that has GPS for the first minute. A second flight has no autopilot, and so knows nothing of its position. The camera
sends Motion JPEG. The map has a budget of 96 MB, that of a Raspberry Pi Zero 2 W: 84,000 of a million places. The
places along the track are pictures of generated ground, which are flown over with noise; the others have random
content. Pictures have 256 pixels, so that the folder takes 9 GB; what a place takes in RAM does not depend on this.
RAM is that of the process, every second.
"""

import argparse
import signal
import subprocess
import threading
import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import ClassVar

import base
import cv2
import numpy as np
import psutil
from base import Row
from big_map import make_big_map
from pictures import textured

from edgevpr.core.config import load_config
from edgevpr.core.geodesy import distance_m
from edgevpr.core.quadkeys import extent_of_key, keys_over
from edgevpr.core.types import Frame, Position
from edgevpr.frames.positions import GeoTag, write_positions
from edgevpr.lab.simulate.processes import autopilot_process, started
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.flight.flightlog import read_log
from edgevpr.runtime.recognise.opening import meter_of
from edgevpr.techniques import create

ZOOM, CORNER, SIDE, PLACES = 14, (47.0, 8.0), 10, 10_000
SIDE_PX, PICTURES_HZ, SPEED_M_S, EVERY_S, PLACE_EVERY_M = 256, 4.0, 40.0, 2.0, 40.0
BUDGET_MB, GPS_S, NEAR_M = 96, 60, 45.0
_COLUMNS = {
    "position": "{flight}",
    "queries": "{queries}",
    "accepted": "{accepted}",
    "wrong": "{wrong}",
    "first": "{first}",
    "tiles loaded": "{loads}",
    "most in RAM": "{most_tiles}",
    "a query takes s, median": "{median_s:.2f}",
    "95 %": "{p95_s:.2f}",
    "most": "{most_s:.2f}",
    "RAM MB": "{ram_mb:.0f}",
}
TECHNIQUE = create("cohog", {"w1": SIDE_PX, "camera": "nadir"})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=SIDE, help="tiles along a side of the map")
    parser.add_argument("--places", type=int, default=PLACES, help="of a tile")
    asked = parser.parse_args()
    with TemporaryDirectory(prefix="edgevpr-tiles-") as work:
        folder = Path(work)
        keys = grid(asked.side)
        track = track_over(keys)
        make_tiles(folder / "tiles", keys, asked.places, track)
        tags = {str(at): GeoTag(position=each, t_utc_s=at * PLACE_EVERY_M / SPEED_M_S) for at, each in enumerate(track)}
        write_positions(folder / "positions.csv", tags)
        Camera.track = track
        server = ThreadingHTTPServer(("127.0.0.1", 0), Camera)
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        flights = {name: fly(folder, name, server.server_port) for name in ("known", "lost")}
    rows = [{"flight": name, **judged(each)} for name, each in flights.items()]
    found = {**base.made_by(), "tiles": len(keys), "places": len(keys) * asked.places, "rows": rows, "flights": flights}
    draw(found, base.RESULTS / "tiled_flight.jpg")
    base.write("tiled_flight", found, page(found))


def grid(side: int) -> list[str]:
    """Return the keys of `side` x `side` tiles."""
    (first,) = keys_over((*CORNER, *CORNER), ZOOM)
    south, west, north, east = extent_of_key(first)
    middle = (south + north) / 2, (west + east) / 2
    far = middle[0] + (side - 1) * (north - south), middle[1] + (side - 1) * (east - west)
    return sorted(keys_over((*middle, *far), ZOOM))


def track_over(keys: list[str]) -> list[Position]:
    """Return the places along a straight way from the south-western tile to the north-eastern one."""
    souths, wests, norths, easts = zip(*map(extent_of_key, keys), strict=True)
    corners = np.array([[min(souths), min(wests)], [max(norths), max(easts)]])
    begin, end = corners[0] + 0.02 * np.diff(corners, axis=0)[0], corners[1] - 0.02 * np.diff(corners, axis=0)[0]
    count = int(distance_m(*begin, *end) / PLACE_EVERY_M)
    return [Position(*at) for at in np.linspace(begin, end, count).tolist()]


def make_tiles(folder: Path, keys: list[str], places: int, track: list[Position]) -> None:
    """Write the tiles: random places in a grid, and those along the track."""
    folder.mkdir()
    meter = meter_of(load_config(None), load_board("this"))
    for number, key in enumerate(keys):
        south, west, north, east = extent_of_key(key)
        along = int(np.ceil(np.sqrt(places)))
        step_deg = (north - south) / along, (east - west) / along
        corner = south + step_deg[0] / 2, west + step_deg[1] / 2
        path = folder / f"{key}.gpkg"
        make_big_map(path, TECHNIQUE.spec, places, number, corner, step_deg)
        here = [at for at, position in enumerate(track) if inside(position, key)]
        with PlaceMap.open_for_adding(path) as place_map:
            frames = (
                Frame(image=textured(at, SIDE_PX, SIDE_PX), name=f"{at:06d}", t_mono_s=0.0, position=track[at])
                for at in here
            )
            build_map(frames, TECHNIQUE, place_map, meter)
        print(f"{key}: {number + 1} of {len(keys)}", flush=True)


def inside(position: Position, key: str) -> bool:
    south, west, north, east = extent_of_key(key)
    return south <= position.lat_deg < north and west <= position.lon_deg < east


class Camera(BaseHTTPRequestHandler):
    """Sends Motion JPEG of the places along the track, from when the first viewer comes."""

    track: ClassVar[list[Position]]
    began_s: ClassVar[float]

    @classmethod
    def place_at(cls, t_mono_s: float) -> int:
        return min(round((t_mono_s - cls.began_s) * SPEED_M_S / PLACE_EVERY_M), len(cls.track) - 1)

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=picture")
        self.end_headers()
        Camera.began_s, rng = time.monotonic(), np.random.default_rng(0)
        with suppress(OSError):
            while True:
                picture = textured(self.place_at(time.monotonic()), SIDE_PX, SIDE_PX)
                seen = np.clip(picture + rng.normal(0, 8, picture.shape), 0, 255).astype(np.uint8)
                jpeg = cv2.imencode(".jpg", seen)[1].tobytes()
                head = f"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")
                time.sleep(1 / PICTURES_HZ)


def fly(folder: Path, name: str, camera: int) -> Row:
    """Fly once with the camera at a port; return the samples of RAM and what the log says of each query."""
    log = folder / f"{name}.jsonl"
    run = ("run", "--map", folder / "tiles", "--source", f"http://127.0.0.1:{camera}/", "--camera", "nadir")
    run += ("--budget-mb", BUDGET_MB, "--rate-hz", 1 / EVERY_S, "--log", log)
    if name == "lost":
        with started(*run) as flight:
            return watched(flight, log)
    told = ("--track", folder / "positions.csv", "--gps-s", GPS_S)
    with autopilot_process(*told) as link, started(*run, "--link", link) as flight:
        return watched(flight, log)


def watched(flight: "subprocess.Popen[bytes]", log: Path) -> Row:
    """End a flight at the end of the track; return its RAM by the second, its queries, and how many tiles were in RAM
    when."""
    process, began_s, ram_mb = psutil.Process(flight.pid), time.monotonic(), list[tuple[float, float]]()
    while time.monotonic() - began_s < len(Camera.track) * PLACE_EVERY_M / SPEED_M_S:
        ram_mb.append((time.monotonic() - began_s, process.memory_info().rss / 1e6))
        time.sleep(1.0)
    flight.send_signal(signal.SIGTERM)
    flight.wait(60)
    lines = list(read_log(log))
    first_s = lines[0]["t_mono_s"]
    queries = [
        {
            "t_s": line["t_frame_s"] - first_s,
            "took_s": line["costs"]["t_encode_s"] + line["costs"]["t_match_s"],
            "off_m": off_m(line, Camera.track[Camera.place_at(line["t_frame_s"])]),
        }
        for line in lines
        if line["kind"] == "query"
    ]
    held = [(line["t_mono_s"] - first_s, len(line["held"])) for line in lines if line["kind"] == "tiles"]
    return {"ram_mb": ram_mb, "queries": queries, "held": held}


def off_m(line: Row, truth: Position) -> float | None:
    """Return how far a match is from the truth; None if it was not accepted."""
    if not line["accepted"]:
        return None
    at = line["located"] or line["position"]
    return float(distance_m(truth.lat_deg, truth.lon_deg, at["lat_deg"], at["lon_deg"]))


def judged(flight: Row) -> Row:
    queries, tiles = flight["queries"], [count for _, count in flight["held"]]
    took_s, off = [each["took_s"] for each in queries], [each["off_m"] for each in queries]
    accepted = [at for at, each in enumerate(off) if each is not None]
    return {
        "queries": len(queries),
        "accepted": len(accepted),
        "wrong": sum(off[at] > NEAR_M for at in accepted),
        "first": accepted[0] + 1 if accepted else None,
        "loads": sum(after > before for before, after in pairwise(tiles)),
        "most_tiles": max(tiles),
        "median_s": float(np.median(took_s)),
        "p95_s": float(np.percentile(took_s, 95)),
        "most_s": max(took_s),
        "ram_mb": max(mb for _, mb in flight["ram_mb"]),
    }


def draw(found: Row, path: Path) -> None:
    """Draw RAM, tiles and queries of both flights over time."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(3, len(found["flights"]), sharex="col", sharey="row", figsize=(11, 7), squeeze=False)
    for column, (name, flight) in zip(axes.T, found["flights"].items(), strict=True):
        column[0].set_title(f"position {name}")
        column[0].plot(*zip(*flight["ram_mb"], strict=True), color="tab:blue")
        column[1].step(*zip(*flight["held"], strict=True), where="post", color="tab:green")
        for is_accepted, colour, label in ((True, "tab:green", "accepted"), (False, "tab:red", "not accepted")):
            there = [each for each in flight["queries"] if (each["off_m"] is not None) == is_accepted]
            at_s, took_s = [[each[name] for each in there] for name in ("t_s", "took_s")]
            column[2].plot(at_s, took_s, ".", color=colour, label=label)
        column[2].set_xlabel("time of flight, s")
    for axis, label in zip(axes[:, 0], ("RAM of the process, MB", "tiles in RAM", "a query takes, s"), strict=True):
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0)
    axes[2, 1].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def page(found: Row) -> str:
    return f"""# Flights over tiles

{base.told(__doc__)}

{base.table(found["rows"], _COLUMNS)}

`first`: the first query that was accepted. Wrong: more than {NEAR_M:g} m from where the picture was taken.

![RAM, tiles in RAM and queries over time](tiled_flight.jpg)

{base.made_line(found, "python benchmarks/tiled_flight.py")}
"""


if __name__ == "__main__":
    base.run(main)
