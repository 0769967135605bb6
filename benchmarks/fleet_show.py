"""A fleet's map before everybody's eyes: `python benchmarks/fleet_show.py --pictures 20000`.

The photographs are real ones of aerial sets whose positions are known (aerial_brighton, aerial_caliterra,
aerial_garfield28, aerial_swindale), {side_px} pixels wide: each as it is, and again and again, turned, brighter or
darker, blurred and with noise, in copies of its site that lie beside it; every fourth is generated. `edgevpr fleet
build` maps them without refining and calibrating by two workers of a Dask scheduler. When a third of the tiles is done,
one worker gets SIGKILL, a browser takes a picture of Dask's dashboard, and another worker is started.

In the end the places in all tiles are counted by the content of their pictures: each photograph that was not refused
must be one place, and only one. How long it took says little: other programs ran beside it.
"""

import argparse
import hashlib
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import base
import cv2
import numpy as np
from base import Row

from edgevpr.core.geodesy import distance_m, moved
from edgevpr.core.quadkeys import extent_of_key, maps_in
from edgevpr.core.types import Position
from edgevpr.fleet import index
from edgevpr.fleet.photos import content_in
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import GeoTag, read_positions, write_positions
from edgevpr.places.mapfile import PlaceMap

SETS = ("aerial_brighton", "aerial_caliterra", "aerial_garfield28", "aerial_swindale")
SIDE_PX, PER_TILE, GENERATED, BESIDE_M = 320, 500, 0.25, 60.0
GENERATED_AT, GENERATED_STEP_M = Position(47.0, 8.0), 25.0
_SEED, _KILL_AT, _WAIT_S = 8, 1 / 3, 60
PICTURES = base.REPOSITORY / "docs" / "pictures"


def changed(image: np.ndarray, number: int) -> np.ndarray:
    """Change a picture as by another flight; number 0 leaves it as it is."""
    if not number:
        return image
    rng = np.random.default_rng((_SEED, number))
    high, wide = image.shape[:2]
    turn = cv2.getRotationMatrix2D((wide / 2, high / 2), rng.uniform(0, 360), 1.3)
    image = cv2.warpAffine(image, turn, (wide, high), borderMode=cv2.BORDER_REFLECT)
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.5))
    light = rng.uniform(0.6, 1.5) * image + rng.normal(0, rng.uniform(1, 8), image.shape)
    return np.clip(light, 0, 255).astype(np.uint8)


def generated(number: int, side_px: int = SIDE_PX) -> np.ndarray:
    """Draw ground that exists nowhere: noise at all scales."""
    rng, ground = np.random.default_rng((_SEED, 1, number)), np.zeros((side_px * 3 // 4, side_px, 3))
    for cells in (4, 12, 36, 108):
        noise = rng.normal(0, 60, (cells * 3 // 4, cells, 3))
        ground += cv2.resize(noise, (side_px, side_px * 3 // 4), interpolation=cv2.INTER_CUBIC) / np.sqrt(cells / 4)
    return np.clip(128 + ground, 0, 255).astype(np.uint8)


def real(count: int) -> Iterator[tuple[str, np.ndarray, GeoTag]]:
    """Yield `count` names, pictures and tags of real photographs: each site, then copies of it beside it."""
    sites = []
    for folder in base.find_sets(names=SETS):
        tags = {name: tag for name, tag in read_positions(folder / "positions.csv").items() if tag.position}
        paths = {path.name: path for part in ("ref", "query") for path in (folder / part).iterdir()}
        sites.append((folder.name, {name: (paths[name], tag) for name, tag in tags.items() if name in paths}))
    images = {path: small(read_image(path)) for _, found in sites for path, _ in found.values()}
    across = int(np.ceil(np.sqrt(count / len(images))))
    copy = written = 0
    while written < count:
        for site, found in sites:
            points = np.array([(tag.position.lat_deg, tag.position.lon_deg) for _, tag in found.values()])
            (south, west), (north, east) = points.min(axis=0), points.max(axis=0)
            size_m = distance_m(south, west, south, east) + BESIDE_M, distance_m(south, west, north, west) + BESIDE_M
            for name, (path, tag) in list(found.items())[: count - written]:
                by_m = (copy % across * size_m[0], copy // across * size_m[1])
                position = Position(*moved(tag.position.lat_deg, tag.position.lon_deg, *map(float, by_m)))
                image = changed(images[path], copy * len(images) + written if copy else 0)
                yield f"{site}/{copy:03d}_{Path(name).stem}.jpg", image, GeoTag(position=position)
                written += 1
        copy += 1


def small(image: np.ndarray) -> np.ndarray:
    high, wide = image.shape[:2]
    return cv2.resize(image, (SIDE_PX, round(SIDE_PX * high / wide)), interpolation=cv2.INTER_AREA)


def write_pictures(folder: Path, count: int) -> dict[str, str]:
    """Write the photographs, a folder a site with its table; return their paths by their content."""
    made, tables, by_content = int(GENERATED * count), dict[str, dict[str, GeoTag]](), {}
    across = int(np.ceil(np.sqrt(made)))

    def drawn() -> Iterator[tuple[str, np.ndarray, GeoTag]]:
        for number in range(made):
            offset_m = [GENERATED_STEP_M * each for each in divmod(number, across)]
            at = Position(*moved(GENERATED_AT.lat_deg, GENERATED_AT.lon_deg, *offset_m))
            yield f"generated/{number:05d}.jpg", generated(number), GeoTag(position=at)

    for pictures in (real(count - made), drawn()):
        for name, image, tag in pictures:
            site, _, file = name.partition("/")
            (folder / site).mkdir(parents=True, exist_ok=True)
            content = cv2.imencode(".jpg", image)[1].tobytes()
            (folder / name).write_bytes(content)
            tables.setdefault(site, {})[file] = tag
            by_content[hashlib.sha256(content).hexdigest()] = str(folder / name)
    for site, tags in tables.items():
        write_positions(folder / site / "positions.csv", tags)
    return by_content


class Cluster:
    """A scheduler with a dashboard, and workers, each a process."""

    def __init__(self, work: Path) -> None:
        self.log, self.told = (work / "dask.log").open("ab"), work / "scheduler.json"
        self.processes = [
            self._start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address", ":0")
        ]
        self.workers = [self.add(), self.add()]

    def _start(self, program: str, *words: str) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-m", f"distributed.cli.{program}", "--scheduler-file", str(self.told), *words]
        return subprocess.Popen(command, stdout=self.log, stderr=self.log)

    def add(self) -> "subprocess.Popen[bytes]":
        self.processes.append(self._start("dask_worker", "--nthreads", "1", "--no-nanny", "--no-dashboard"))
        return self.processes[-1]

    def known(self) -> Row:
        """Return the addresses of the scheduler and its dashboard."""
        from dask.distributed import Client

        for _ in range(10 * _WAIT_S):
            with suppress(OSError, ValueError), Client(scheduler_file=str(self.told), timeout=5) as client:
                client.wait_for_workers(len(self.workers), timeout=_WAIT_S)
                return {"scheduler": client.scheduler.address, "dashboard": client.dashboard_link}
            time.sleep(0.1)
        raise base.EdgevprError(f"The workers do not start: see {self.log.name}.")

    def stop(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


def photographed(address: str, path: Path) -> bool:
    """Take a picture of a page by Chromium; False where there is none."""
    from playwright.sync_api import sync_playwright

    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        return False
    with sync_playwright() as started:
        page = started.chromium.launch(executable_path=browser, args=["--no-sandbox"]).new_page(
            viewport={"width": 1200, "height": 700}
        )
        page.goto(address)
        page.wait_for_timeout(6000)  # Bokeh draws what the scheduler sends, a few times a second
        page.screenshot(path=path)
    base.shrink(path)
    return True


def build(work: Path, log: Path) -> Row:
    """Run the command, kill a worker on the way, and return what happened."""
    cluster, maps = Cluster(work), work / "maps"
    folders = sorted(str(path) for path in (work / "pictures").iterdir())
    try:
        known = cluster.known()
        words = ["fleet", "build", str(maps), "--images", *folders, "--camera", "nadir", "--no-refine"]
        words += ["--no-calibrate", "--places-per-tile", str(PER_TILE), "--scheduler", known["scheduler"], "--json"]
        began_s, killed = time.monotonic(), {}
        with log.open("wb") as told:
            command = [sys.executable, "-m", "edgevpr", *words]
            run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=told)
            while run.poll() is None:
                done = len(maps_in(maps))
                if not killed and (total := total_in(log)) and done >= _KILL_AT * total:
                    cluster.workers[0].send_signal(signal.SIGKILL)
                    killed = {"after_tiles": done, "of_tiles": total, "after_s": time.monotonic() - began_s}
                    killed["dashboard"] = photographed(known["dashboard"], PICTURES / "fleet-dashboard.png")
                    cluster.add()
                time.sleep(0.5)
            assert run.stdout
            said = json.loads(run.stdout.read())
        return {"wall_s": time.monotonic() - began_s, "killed": killed, "said": said}
    finally:
        cluster.stop()


def total_in(log: Path) -> int:
    """Return how many tiles the progress tells of; 0: of none yet."""
    found = re.findall(r"tiles  \d+/(\d+)", log.read_text(errors="replace"))
    return int(found[-1]) if found else 0


def counted(maps: Path, by_content: dict[str, str], unusable: list[str]) -> Row:
    """Compare the places in all tiles with the photographs, and with what the command said of those left out."""
    there = {sha256[:12]: path for sha256, path in by_content.items()}
    found: list[str] = []
    for path in maps_in(maps).values():
        with PlaceMap.open(path) as place_map:
            found += [content_in(place.source_image) for place in place_map.places()]
    without = {there[content] for content in there.keys() - set(found)}
    lost = sorted(path for path in without if not any(path in text for text in unusable))
    return {
        "tiles": len(maps_in(maps)),
        "photographs": len(there),
        "places": len(found),
        "doubled": len(found) - len(set(found)),
        "unknown": len(set(found) - there.keys()),
        "refused": len(without) - len(lost),
        "lost": len(lost),
        "unfinished_files": len(list(maps.glob(".*.gpkg*"))),
    }


def draw_index(maps: Path, path: Path) -> Row:
    """Read the layers of the index as other programs do, and draw the outlines of the tiles by their places."""
    import pyogrio
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.patches import Rectangle

    file = maps / index.INDEX
    info, tiles = pyogrio.read_info(file), index.tiles_in(maps)
    regions: dict[tuple[int, int], list[str]] = {}
    for key in tiles:
        south, west, _, _ = extent_of_key(key)
        regions.setdefault((round(south), round(west)), []).append(key)
    drawn, axes = base.panels(11, 5.5, len(regions), rows=2)
    shade = Normalize(0, max(tile.places for tile in tiles.values()))
    colours = colormaps["viridis"]
    for axis, keys in zip(axes, regions.values(), strict=True):
        for key in keys:
            south, west, north, east = extent_of_key(key)
            colour = colours(shade(tiles[key].places))
            axis.add_patch(
                Rectangle((west, south), east - west, north - south, facecolor=colour, edgecolor="k", lw=0.5)
            )
        axis.autoscale_view()
        axis.ticklabel_format(useOffset=False)
        axis.locator_params(nbins=3)
        axis.set_title(f"{len(keys)} tiles, {sum(tiles[key].places for key in keys)} places", fontsize=9)
    drawn.colorbar(ScalarMappable(shade, colours), ax=axes, label="places")
    base.save(drawn, path)
    layers = [list(map(str, layer)) for layer in pyogrio.list_layers(file)]
    return {"layers": layers, "features": int(info["features"]), "crs": info["crs"], "fields": list(info["fields"])}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--pictures", type=int, default=20_000)
    parser.add_argument("--work", type=Path, default=Path("fleet_show_work"), help="folder for pictures and maps")
    args = parser.parse_args()
    work = args.work.absolute()
    shutil.rmtree(work, ignore_errors=True)
    (work / "pictures").mkdir(parents=True)
    by_content = write_pictures(work / "pictures", args.pictures)
    print(f"{len(by_content)} pictures", flush=True)
    log = work / "progress.log"
    found: Row = {**base.made_by(), "asked": args.pictures, **build(work, log)}
    lines = [line for line in log.read_text().splitlines() if line.startswith("tiles ")]
    found |= {
        "progress": lines[:: max(1, len(lines) // 10)],
        "counted": counted(work / "maps", by_content, found["said"]["unusable"]),
    }
    found["said"]["unusable"], found["said"]["new"] = len(found["said"]["unusable"]), len(found["said"]["new"])
    found["index"] = draw_index(work / "maps", PICTURES / "fleet-index.png")
    print(found, flush=True)
    base.write("fleet_show", found, page(found))
    if any(found["counted"][name] for name in ("lost", "doubled", "unknown")):
        raise base.EdgevprError("Places are lost, doubled, or of no photograph: see fleet_show.json.")


def page(found: Row) -> str:
    names = ("photographs", "tiles", "places", "refused", "lost", "doubled", "unknown", "unfinished_files")
    columns = {name.replace("_", " "): f"{{{name}}}" for name in names} | {"minutes": "{minutes:.1f}"}
    killed, progress, layer = found["killed"], "\n".join(found["progress"]), found["index"]["layers"][0]
    said = json.dumps({name: value for name, value in found["said"].items() if name != "maps"})
    return f"""# A fleet's map of {found["counted"]["photographs"]:,} photographs

{base.told(__doc__).format(side_px=SIDE_PX)}

{base.table([{**found["counted"], "minutes": found["wall_s"] / 60}], columns, left=0)}

The worker was killed after {killed["after_s"]:.0f} s, with {killed["after_tiles"]} of {killed["of_tiles"]} tiles done.
A few seconds later Dask's dashboard showed:

![Dask's dashboard with one worker left](../../docs/pictures/fleet-dashboard.png)

What the command said on the way, and in the end:

```
{progress}
{said}
```

`index.gpkg`, as GDAL reads it, has the layer `{layer[0]}` ({layer[1]}) with
{found["index"]["features"]} features in {found["index"]["crs"]}, and the columns
{", ".join(found["index"]["fields"])}. Its outlines, by the places:

![The outlines of the tiles](../../docs/pictures/fleet-index.png)

{base.made_line(found, f"python benchmarks/fleet_show.py --pictures {found['asked']}")}
"""


if __name__ == "__main__":
    base.run(main)
