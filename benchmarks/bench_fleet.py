"""How map making grows with the workers: `make bench-fleet`, or `python benchmarks/bench_fleet.py --large`.

`edgevpr fleet build` maps tiles of the raster `before` of sat_marash by the workers of Dask on this computer, each a
process of one thread. The places lie 62 or 31 m apart (--large: 9.6 m, too), and are not calibrated. The serial part
and the shared one are those for which T(w) = serial + shared / w gives the times measured with one and two workers: in
so small a job the serial part is mostly the wait for the last tile. The projection holds for a job of this size, and
assumes that nothing else grows with the workers: that the store gives each of them its pictures as fast as a local disk
gives them to one.
Read and written is what the workers asked Linux for, page cache and logs included. RAM is the peak of the largest
worker.
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

import base
import psutil
from base import Row

from edgevpr.core.config import load_config
from edgevpr.fleet import building
from edgevpr.fleet.worker import FleetOrder
from edgevpr.mapmaking.making import Cuttings

SET, FOOTPRINT_M, PER_TILE = "sat_marash", 156.0, 100
SPACINGS_M, WORKERS, PROJECTED, LARGE = (62.0, 31.0), (1, 2), (10, 100), 10_000_000
LARGE_SPACING_M = 9.6  # 10,000 places: half an hour of two cores. 100,000 would take them half a day
_COLUMNS = {
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


def used() -> tuple[int, int, int]:
    """Return what this process has read and written, and its peak of RAM, in bytes."""
    counted = psutil.Process().io_counters()
    return counted.read_chars, counted.write_chars, 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def measure(path: Path, spacing_m: float, workers: int, out: Path) -> Row:
    from dask.distributed import Client, LocalCluster

    cuttings = Cuttings(orthophoto=str(path), footprint_m=FOOTPRINT_M, spacing_m=spacing_m)
    order = FleetOrder(out=out, config=load_config(None), camera="nadir", refine=False, calibrate=False)
    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        client.wait_for_workers(workers)
        began_s = time.perf_counter()
        tasks = building.tasks_of_orthophoto(cuttings, PER_TILE, None)
        done = list(building.build(order, tasks, cluster.scheduler_address, None, lambda items, *_: items))
        wall_s = time.perf_counter() - began_s
        read, written, ram = zip(*client.run(used).values(), strict=True)
    places = sum(each.tile.places for each in done if each.tile)
    found: Row = {
        "places": places,
        "tiles": sum(bool(each.tile) for each in done),
        "workers": workers,
        "wall_s": wall_s,
    }
    found |= {"read_kb": sum(read) / places / 1e3, "written_kb": sum(written) / places / 1e3, "ram_mb": max(ram) / 1e6}
    return found | {"per_s": places / wall_s}


def projected(one: Row, two: Row) -> list[Row]:
    """Return the rows of two measurements, with their efficiency, and those of more workers."""
    serial_s = max(2 * two["wall_s"] - one["wall_s"], 0.0)
    shared_s = one["wall_s"] - serial_s
    rows = [one, two] + [
        {
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
    parser.add_argument("--large", action="store_true")
    spacings_m = (*SPACINGS_M, *((LARGE_SPACING_M,) if parser.parse_args().large else ()))
    (folder,) = base.find_sets(names=[SET])
    path, rows = folder / "raster" / "before.vrt", []
    with tempfile.TemporaryDirectory(prefix="edgevpr-fleet-") as work:
        for spacing_m in spacings_m:
            both = [measure(path, spacing_m, count, Path(work) / f"{spacing_m:g} {count}") for count in WORKERS]
            print(*both, sep="\n", flush=True)
            rows += projected(*both)
    found = {**base.made_by(), "rows": rows}
    base.write("fleet", found, page(found))


def page(found: Row) -> str:
    one, two = [row for row in found["rows"] if row["places"] == found["rows"][-1]["places"]][:2]
    alone_h = LARGE / one["per_s"] / 3600
    return f"""# Map making by many workers

{base.told(__doc__)}

{base.table(found["rows"], _COLUMNS)}

On paper: ten million places, 30 m apart over 9,000 km2, take {alone_h:.0f} hours of one core of this machine, and write
{LARGE * two["written_kb"] / 1e9:.2f} TB; a hundred cores with the efficiency of two take
{alone_h / 100 / two["efficiency"]:.1f} hours.

{base.made_line(found, "make bench-fleet")}
"""


if __name__ == "__main__":
    base.run(main)
