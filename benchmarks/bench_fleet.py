"""How map making grows with the workers: `make bench-fleet`, or `python benchmarks/bench_fleet.py --large`.

`edgevpr fleet build` maps two grounds by the workers of Dask on this computer, each a process of one thread: tiles of
the raster `before` of sat_marash, with places 62 or 31 m apart, and photographs of `fleet_pictures.py`, 1,000 and
10,000 (--large: 100,000, by two workers; it takes an hour). They are not calibrated, and not refined. The serial part
and the shared one are those for which T(w) = serial + shared / w gives the times measured with one and two workers: in
a small job the serial part is mostly the wait for the last tile; an efficiency above 1 is noise of the machine. The
projection holds for a job of this size, and assumes that nothing else grows with the workers: that the store gives each
of them its pictures as fast as a local disk gives them to one.
Read and written is what the workers asked Linux for, page cache and logs included. RAM is the peak of the largest
worker.
"""

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import base
import psutil
from base import Row
from fleet_pictures import write_pictures

from edgevpr.core.config import load_config
from edgevpr.core.text import progress
from edgevpr.fleet import building
from edgevpr.fleet.photos import photos_of
from edgevpr.fleet.worker import FleetOrder, TileTask
from edgevpr.mapmaking.making import Cuttings

SET, FOOTPRINT_M, SPACINGS_M, PER_TILE = "sat_marash", 156.0, (62.0, 31.0), 100
PHOTOGRAPHS = {1000: 500, 10_000: 2000}  # and the most in a tile: the fewer, the more are read for a tile beside it
LARGE_PHOTOGRAPHS, LARGE_PER_TILE = 100_000, 10_000
RESULT = base.RESULTS / "fleet.json"
WORKERS, PROJECTED, ON_PAPER = (1, 2), (10, 100), 10_000_000
_COLUMNS = {
    "ground": "{ground}",
    "places": "{places}",
    "tiles": "{tiles}",
    "workers": "{workers}",
    "s": "{wall_s:.0f}",
    "places a second": "{per_s:.1f}",
    "efficiency": "{efficiency:.2f}",
    "read KB a place": "{read_kb:.0f}",
    "written KB a place": "{written_kb:.0f}",
    "RAM of a worker MB": "{ram_mb:.0f}",
}
_PAPER = {
    "ground": "{ground}",
    "hours of one core": "{alone_h:.0f}",
    "hours of a hundred, with the efficiency of two": "{hundred_h:.1f}",
    "read TB": "{read_tb:.2f}",
    "written TB": "{written_tb:.2f}",
}


def used() -> tuple[int, int, int]:
    """Return what this process has read and written, and its peak of RAM, in bytes."""
    counted = psutil.Process().io_counters()
    return counted.read_chars, counted.write_chars, 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def measure(tasks: Sequence[TileTask], workers: int, out: Path) -> Row:
    from dask.distributed import Client, LocalCluster

    order = FleetOrder(out=out, config=load_config(None), camera="nadir", refine=False, calibrate=False)
    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        client.wait_for_workers(workers)
        began_s = time.perf_counter()
        done = list(building.build(order, tasks, cluster.scheduler_address, None, progress))
        wall_s = time.perf_counter() - began_s
        read, written, ram = zip(*client.run(used).values(), strict=True)
    places = sum(each.tile.places for each in done if each.tile)
    found: Row = {
        "ground": "photographs" if tasks[0].photos else "raster",
        "places": places,
        "tiles": sum(bool(each.tile) for each in done),
        "workers": workers,
        "wall_s": wall_s,
    }
    found |= {"read_kb": sum(read) / places / 1e3, "written_kb": sum(written) / places / 1e3, "ram_mb": max(ram) / 1e6}
    print(found, flush=True)
    return found | {"per_s": places / wall_s}


def tasks_of_raster(spacing_m: float) -> list[TileTask]:
    (folder,) = base.find_sets(names=[SET])
    path = folder / "raster" / "before.vrt"
    cuttings = Cuttings(orthophoto=str(path), footprint_m=FOOTPRINT_M, spacing_m=spacing_m)
    return building.tasks_of_orthophoto(cuttings, PER_TILE, None)


def tasks_of_photographs(count: int, per_tile: int, folder: Path) -> list[TileTask]:
    if not folder.exists():
        write_pictures(folder, count)
    photos = photos_of(sorted(map(str, folder.iterdir())))
    return building.tasks_of_photos(photos, per_tile, None)[0]


def projected(one: Row, two: Row) -> list[Row]:
    """Return the rows of two measurements, with their efficiency, and those of more workers."""
    serial_s = max(2 * two["wall_s"] - one["wall_s"], 0.0)
    shared_s = one["wall_s"] - serial_s
    rows = [one, two] + [
        {
            "ground": one["ground"],
            "places": one["places"],
            "workers": f"{count} (projected)",
            "wall_s": serial_s + shared_s / count,
            "count": count,
        }
        for count in PROJECTED
    ]
    for row in rows:
        count = row.get("count", row["workers"])
        row |= {"per_s": row["places"] / row["wall_s"], "efficiency": one["wall_s"] / count / row["wall_s"]}
    return rows


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--large", action="store_true", help=f"map {LARGE_PHOTOGRAPHS:,} photographs, and nothing else")
    parser.add_argument("--pictures", type=Path, help="their folder, which is made if it is not there")
    asked = parser.parse_args()
    found: Row = json.loads(RESULT.read_text())  # of the other jobs
    with tempfile.TemporaryDirectory(prefix="edgevpr-fleet-") as made:
        work = Path(made)
        if asked.large:
            tasks = tasks_of_photographs(LARGE_PHOTOGRAPHS, LARGE_PER_TILE, asked.pictures or work / "large")
            found["large"] = {**base.made_by(), "row": measure(tasks, WORKERS[-1], work / "maps")}
        else:
            found |= {**base.made_by(), "rows": list(small_jobs(work))}
    base.write("fleet", found, page(found))


def small_jobs(work: Path) -> Iterator[Row]:
    def measured(name: str, tasks: Sequence[TileTask]) -> list[Row]:
        return projected(*[measure(tasks, count, work / f"maps {name} {count}") for count in WORKERS])

    for spacing_m in SPACINGS_M:
        yield from measured(f"{spacing_m:g}", tasks_of_raster(spacing_m))
    for number, per_tile in PHOTOGRAPHS.items():
        yield from measured(f"{number}", tasks_of_photographs(number, per_tile, work / f"{number}"))


def on_paper(ground: str, rows: Sequence[Row]) -> Row:
    """Return the cost of a job of `ON_PAPER` places, from the largest job that one worker and two have done."""
    one, two = [[row for row in rows if row["ground"] == ground and row["workers"] == count][-1] for count in WORKERS]
    alone_h = ON_PAPER / one["per_s"] / 3600
    return {
        "ground": ground,
        "alone_h": alone_h,
        "hundred_h": alone_h / 100 / two["efficiency"],
        "read_tb": ON_PAPER * two["read_kb"] / 1e9,
        "written_tb": ON_PAPER * two["written_kb"] / 1e9,
    }


def page(found: Row) -> str:
    rows, large, by = found["rows"], found["large"], "python benchmarks/bench_fleet.py --large"
    return f"""# Map making by many workers

{base.told(__doc__)}

{base.table([*rows, large["row"]], _COLUMNS, left=1)}

On paper, {ON_PAPER:,} places, from the largest job that one worker and two have done:

{base.table([on_paper(ground, rows) for ground in ("raster", "photographs")], _PAPER)}

{base.made_line(found, "make bench-fleet")}
The last row: {base.made_line(large, by)}
"""


if __name__ == "__main__":
    base.run(main)
