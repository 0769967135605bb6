"""One map of many sites, as it grows to ten thousand places: `make sites`.

All aerial sets form one map for a nadir camera; corridor and grief_stromovka_seasons form one for a forward camera.
Each query is matched against all places of the map, without any prior of its position. The maps are nested: first come
right places for all queries (as few as possible), then the other pictures of the sites, then foreign places
(`foreign_places.py`), whose kinds have the same share at every size. So up to the number of all pictures of the sites a
larger map also has more right places; beyond it, only more foreign ones.

Places have no positions, so the confidence is that of the shipped model, and nadir landmarks show which places are of
the same ground. Each map is matched in a process of its own, with one thread. Times are CPU times. For the nadir
camera, a third of the foreign places is mirrored ground of the same sites.

Each measured row is kept in sites_work/, so that an interrupted run continues.
"""

import argparse
import json
import subprocess
import sys
from collections import Counter
from itertools import chain
from pathlib import Path

import base
import numpy as np
import walks
from base import Row
from flight_process import read_memory_mb
from foreign_places import MIRRORED_PREFIX, yield_foreign_places
from run_sets import join_sets

from edgevpr.lab.evaluate.dataset import Dataset, ScoredQuery
from edgevpr.lab.evaluate.metrics import wilson_interval
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.examine import check_places
from edgevpr.places.index import compute_place_bytes
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.opening import open_recogniser

SIZES = (50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000)
TITLES = {"nadir": "Nadir camera", "forward": "Forward camera"}
FORWARD_SETS = ("corridor", "grief_stromovka_seasons")  # the forward sets that are large enough
WORK = Path("sites_work")
_MAX_NEIGHBOUR_STEPS = 2  # in pictures of the site, as for maps without positions
_QUALITY_COLUMNS = {
    "places": "{places}",
    "of the sites": "{of_sites}",
    "recall@1": "{recall_at_1:.3f}",
    "95 %": "{recall_at_1_interval[0]:.3f} to {recall_at_1_interval[1]:.3f}",
    "accepted right": "{accepted_right}",
    "accepted neighbour": "{accepted_beside}",
    "accepted wrong": "{accepted_wrong}",
    "wrong best places": "{where}",
}
_COST_COLUMNS = {
    "places": "{places}",
    "encode ms": "{t_encode_ms:.1f}",
    "scan ms": "{t_scan_ms:.1f}",
    "query ms": "{t_query_ms:.1f}",
    "90 % of queries, ms": "{t_query_p90_ms:.1f}",
    "bytes per place in RAM": "{row_bytes}, with id and position {bytes_per_place}",
    "peak RAM MB": "{peak_mb:.0f}",
    "map MB": "{map_mb:.0f}",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--measure", nargs=2, metavar=("CAMERA", "PLACES"), help="measure one map in this process")
    args = parser.parse_args()
    if args.measure:
        camera, places = args.measure
        print(json.dumps(measure_map(camera, int(places))))
        return
    rows = []
    for camera in TITLES:
        _build_whole_map(camera)
        sizes = sorted({*SIZES, len(load_joined_set(camera).references)})
        rows += [measure_in_subprocess(camera, places) for places in sizes]
    result = {**base.describe_run(), "rows": rows}
    base.write("sites", result, format_page(result))


def measure_in_subprocess(camera: str, places: int) -> Row:
    """Return the row of one map, measured in a process of its own unless WORK has it."""
    command = [sys.executable, __file__, "--measure", camera, str(places)]
    return base.measure_once(WORK / f"{camera}_{places}.json", lambda: json.loads(subprocess.check_output(command)))


def list_folders(camera: str) -> list[Path]:
    return base.find_sets(names=FORWARD_SETS if camera == "forward" else None, camera=camera)


def load_joined_set(camera: str) -> Dataset:
    """Return the sets of one camera, joined into one set."""
    joined = WORK / f"{camera}_sites"
    if not (joined / "ground_truth.csv").exists():
        join_sets(list_folders(camera), joined)
    return walks.load_matched_set(joined)


def _build_whole_map(camera: str) -> None:
    """Build the map of all places in WORK, unless it exists."""
    path, unfinished = WORK / f"{camera}.gpkg", WORK / f"{camera}_unfinished.gpkg"
    if path.exists():
        return
    unfinished.unlink(missing_ok=True)
    dataset, technique = load_joined_set(camera), walks.make_cohog(camera)
    foreign_frames = yield_foreign_places(camera, max(SIZES) - len(dataset.references), base.DATA, list_folders(camera))
    with PlaceMap.create(unfinished, technique.spec) as place_map:
        frames = chain(walks.read_folder_frames(dataset.ref_dir), foreign_frames)
        build_map(frames, FrameEncoder(technique=technique), place_map)
    unfinished.rename(path)


def choose_places(dataset: Dataset, names: list[str], count: int) -> set[str]:
    """Return the names of the `count` places of a map, in nested order (see the top of this file)."""
    rng = np.random.default_rng(0)
    cover = find_cover([query.correct for query in dataset.queries])
    others = [name for name in dataset.references if name not in set(cover)]
    foreign = sorted(set(names) - set(dataset.references))
    for group in (others, foreign):
        rng.shuffle(group)
    return set([*cover, *others, *foreign][:count])


def find_cover(name_sets: list[frozenset[str]]) -> list[str]:
    """Return a few names such that each set has at least one: a greedy cover, by the name of most uncovered sets."""
    cover = []
    while name_sets:
        counts = Counter(name for names in name_sets for name in sorted(names))
        cover.append(max(sorted(counts), key=lambda name: counts[name]))
        name_sets = [names for names in name_sets if cover[-1] not in names]
    return cover


def copy_places(dataset: Dataset, camera: str, count: int) -> Path:
    """Copy `count` places from the map of all places to a new map, in the same order, and return its path."""
    path = WORK / f"{camera}_{count}.gpkg"
    path.unlink(missing_ok=True)
    with PlaceMap.open(WORK / f"{camera}.gpkg") as full_map:
        names = {place.place_id: place.source_image for place in full_map.read_places()}
        chosen = choose_places(dataset, list(names.values()), count)
        with PlaceMap.create(path, full_map.spec) as place_map, place_map.transaction():
            for entry in check_places(full_map):
                if names.get(entry.place_id) in chosen:
                    place_map.insert(entry.content)
    return path


def measure_map(camera: str, count: int) -> Row:
    """Match every query in the map of `count` places and return the row of the map. `accepted_right` counts matches
    accepted with a right place, or with one that the truth ignores; `accepted_beside` those with a place at most two
    pictures from a right one, which the truth does not list; `accepted_wrong` all others. `wrong_by` counts wrong best
    places: on the query's own site, on another site, or by the kind of foreign place. Times are CPU times: medians, and
    a 90th percentile; `peak_mb` is the highest resident memory of the process."""
    dataset, sites = load_joined_set(camera), [folder.name for folder in list_folders(camera)]
    path = copy_places(dataset, camera, count)
    recogniser = open_recogniser(walks.make_config(map=str(path), **{"source.camera": camera}), load_board("this"))
    hits, costs, wrong_by, accepted, neighbours, wrong = [], [], Counter(), 0, 0, []
    with recogniser.place_map as place_map:
        names = walks.read_names(place_map, recogniser.index)
        queries = (dataset.queries[0], *dataset.queries)  # the first is not counted: it loads tables and the disk cache
        for number, query in enumerate(queries):
            event = recogniser.step(walks.make_frame(query.path))
            ranked = walks.list_ranked_names(event, names)
            if number == 0:
                continue
            best = next((name for name in ranked if name not in query.ignored), None)
            hits.append(best in query.correct)
            if best and not hits[-1]:
                wrong_by[_classify_wrong_place(best, query.path.name, sites)] += 1
            accepted += event.accepted
            if event.accepted and ranked[0] not in query.correct | query.ignored:
                is_neighbour = _is_neighbour(ranked[0], query, dataset)
                neighbours += is_neighbour
                wrong += [] if is_neighbour else [(query.path.name, ranked[0])]
            costs.append((event.steps.encode.cpu_s, event.steps.scan.cpu_s, event.cost.cpu_s))
        peak_mb = read_memory_mb("self")["VmHWM"]
    t_encode_ms, t_scan_ms, t_query_ms = (1000 * np.median(costs, axis=0)).round(2).tolist()
    spec = recogniser.technique.spec
    row = {
        "camera": camera,
        "places": len(recogniser.index),
        "of_sites": sum(name in set(dataset.references) for name in names),
        "queries": len(hits),
        "recall_at_1": round(float(np.mean(hits)), 4),
        "recall_at_1_interval": wilson_interval(np.array(hits)),
        "accepted_right": int(accepted) - neighbours - len(wrong),
        "accepted_beside": neighbours,
        "accepted_wrong": len(wrong),
        "wrong_by": dict(wrong_by),
        "accepted_wrong_names": wrong,
        "t_encode_ms": t_encode_ms,
        "t_scan_ms": t_scan_ms,
        "t_query_ms": t_query_ms,
        "t_query_p90_ms": round(1000 * float(np.percentile([cost[2] for cost in costs], 90)), 1),
        "bytes_per_place": compute_place_bytes(spec),
        "row_bytes": spec.row.nbytes,
        "peak_mb": round(peak_mb, 1),
        "map_mb": round(path.stat().st_size / 1e6, 1),
    }
    path.unlink()
    return row


def _is_neighbour(place: str, query: ScoredQuery, dataset: Dataset) -> bool:
    """Return True if a place is at most two pictures before or after a right one, in the order of the site."""
    if place not in dataset.references:
        return False
    right = [dataset.references.index(name) for name in query.correct | query.ignored]
    return min(abs(dataset.references.index(place) - index) for index in right) <= _MAX_NEIGHBOUR_STEPS


def _classify_wrong_place(place: str, query: str, sites: list[str]) -> str:
    """Return where a wrong place is: on the query's own site, on another site, or the kind of foreign place."""
    site = next(name for name in sites if query.startswith(name))
    kind, _, rest = place.rpartition("/")[0].partition("/")
    if kind == MIRRORED_PREFIX:
        return f"{MIRRORED_PREFIX} {'own' if rest.startswith(site) else 'another'} site"
    return kind or ("own site" if place.startswith(site) else "another site")


def format_page(result: Row) -> str:
    """Return the results as Markdown."""
    parts = ["# One map of many sites", base.strip_title(__doc__, "Each measured row")]
    for camera, title in TITLES.items():
        rows = [dict(row) for row in result["rows"] if row["camera"] == camera]
        for row in rows:
            row["where"] = ", ".join(f"{count} {kind}" for kind, count in sorted(row["wrong_by"].items())) or "-"
        parts.append(f"## {title}: {rows[0]['queries']} queries")
        parts += [base.format_table(rows, columns) for columns in (_QUALITY_COLUMNS, _COST_COLUMNS)]
    return "\n\n".join([*parts, base.format_origin(result, "make sites")])


if __name__ == "__main__":
    base.run(main)
