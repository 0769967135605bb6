"""Confidence in a map that is put together of several tiles: `python benchmarks/bench_subset.py`.

The raster `before` of sat_marash is mapped as five tiles of 2 to 412 places, each calibrated as `edgevpr fleet build`
calibrates it, and `edgevpr map subset` takes them all: with the most cautious of their calibrations, as it does, and
without any, as the shipped confidence flies. Beside it stands one map of the same ground, calibrated as a whole. Over
each the flight of `make from-space` is matched, picture by picture, and pictures of the set's other sites (foreign),
which all must be refused. The set is one of those that the shipped confidence was tuned on; the way to join
calibrations was not. All tiles are of one town: where they differ more, the most cautious costs more.
"""

import shutil
import tempfile
from itertools import islice
from pathlib import Path

import base
import from_space
from base import Row

from edgevpr.core.config import load_config
from edgevpr.fleet import building
from edgevpr.fleet.worker import FleetOrder, build_tile
from edgevpr.mapmaking.making import Cuttings
from edgevpr.places.mapfile import PlaceMap

_ZOOM, _EVERY = 15, 8  # of the tiles; of the foreign pictures
_COLUMNS = {"map": "{map}", **{name: f"{{{name}}}" for name in ("known", "places", "queries", "accepted", "wrong")}}


def tiled(raster: Path, out: Path) -> None:
    """Map a raster tile by tile."""
    out.mkdir()
    cuttings = Cuttings(
        orthophoto=str(raster), footprint_m=round(from_space.FOOTPRINT_M, 1), spacing_m=from_space.SPACING_M
    )
    order = FleetOrder(out=out, config=load_config(None), camera="nadir")
    for task in building.tasks_of_orthophoto(cuttings, 0, _ZOOM):
        done = build_tile(task, order)
        print(done.key, done.problem or (done.tile and (done.tile.places, done.tile.expected)), flush=True)


def main() -> None:
    (folder,) = base.find_sets(names=[from_space.SET])
    before, rows = folder / "raster" / "before.vrt", []
    frames = list(from_space.flown(folder / "raster" / "after.vrt"))
    with tempfile.TemporaryDirectory(prefix="edgevpr-subset-") as name:
        work = Path(name)
        tiled(before, work / "tiles")
        paths = {each: work / f"{each}.gpkg" for each in ("subset, joined", "subset, shipped", "one map")}
        area = ",".join(f"{value:.6f}" for value in (frames[0].position.lat_deg, frames[0].position.lon_deg, 9000))
        base.edgevpr("map", "subset", work / "tiles", "--mission", area, "--out", paths["subset, joined"])
        shutil.copy(paths["subset, joined"], paths["subset, shipped"])
        with PlaceMap.open_for_adding(paths["subset, shipped"]) as place_map:
            place_map.record_calibration(None)
        size = ("--footprint-m", f"{from_space.FOOTPRINT_M:.1f}", "--spacing-m", f"{from_space.SPACING_M:g}")
        base.edgevpr("map", "build", paths["one map"], "--orthophoto", before, *size)
        for name, path in paths.items():
            for known in ("nothing", "heading, height"):
                rows.append({"map": name, **from_space.matched(path, frames, known)})
            foreign = islice(from_space.foreign(folder), 0, None, _EVERY)
            rows.append({"map": name, **from_space.matched(path, foreign, "heading, height"), "known": "foreign"})
            print(*rows[-3:], sep="\n", flush=True)
    found: Row = {**base.made_by(), "rows": rows}
    base.write("subset", found, page(found))


def page(found: Row) -> str:
    return f"""# A map put together of several tiles

{base.told(__doc__)}

{base.table(found["rows"], _COLUMNS, left=2)}

{base.made_line(found, "python benchmarks/bench_subset.py")}
"""


if __name__ == "__main__":
    base.run(main)
