"""One map out of many sites, as it grows to ten thousand places: `make sites`.

All sets from the air are one map looking down, and corridor and grief_stromovka_seasons one looking ahead. Each query
asks for its place among all of them, as in a flight that knows nothing of where it is. The maps are nested: first a
right place for every query (as few as that takes), then the other pictures of the sites, then places that are nowhere
near (`foreign_places.py`), in equal mixture at every size. So up to the size of all sites, right places come in too;
from there on only foreign ones do.

Places have no positions: the confidence is the shipped one, and looking down landmarks tell which places show the same
ground. Each map is asked in a process of its own, one thread. Times are of the processor. Looking down, a
third of the foreign places is mirrored ground of the very sites.

What is measured stays in sites_work/, so that an interrupted run goes on.
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
TITLES = {"nadir": "Looking straight down", "forward": "Looking ahead"}
FORWARD_SETS = ("corridor", "grief_stromovka_seasons")  # the sets that look ahead and are large enough to be asked
WORK = Path("sites_work")
_MAX_NEIGHBOUR_STEPS = 2  # pictures, as where a map has no positions
_QUALITY_COLUMNS = {
    "places": "{places}",
    "of the sites": "{of_sites}",
    "recall@1": "{recall_at_1:.3f}",
    "95 %": "{recall_at_1_interval[0]:.3f} to {recall_at_1_interval[1]:.3f}",
    "accepted right": "{accepted_right}",
    "beside": "{accepted_beside}",
    "wrong": "{accepted_wrong}",
    "best place wrong: where": "{where}",
}
_COST_COLUMNS = {
    "places": "{places}",
    "encode ms": "{t_encode_ms:.1f}",
    "scan ms": "{t_scan_ms:.1f}",
    "query ms": "{t_query_ms:.1f}",
    "90 % of queries, ms": "{t_query_p90_ms:.1f}",
    "bytes a place in RAM": "{row_bytes}, with id and position {bytes_per_place}",
    "peak RAM MB": "{peak_mb:.0f}",
    "map MB": "{map_mb:.0f}",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--measure", nargs=2, metavar=("CAMERA", "PLACES"), help="one map, in this process")
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
    """Measure one map in a process of its own, unless its row is in WORK."""
    command = [sys.executable, __file__, "--measure", camera, str(places)]
    return base.measure_once(WORK / f"{camera}_{places}.json", lambda: json.loads(subprocess.check_output(command)))


def list_folders(camera: str) -> list[Path]:
    return base.find_sets(names=FORWARD_SETS if camera == "forward" else None, camera=camera)


def load_joined_set(camera: str) -> Dataset:
    """Return the sets of one camera as one set."""
    joined = WORK / f"{camera}_sites"
    if not (joined / "ground_truth.csv").exists():
        join_sets(list_folders(camera), joined)
    return walks.load_matched_set(joined)


def _build_whole_map(camera: str) -> None:
    """Build the map of all places, unless it is there."""
    path, unfinished = WORK / f"{camera}.gpkg", WORK / f"{camera}_unfinished.gpkg"
    if path.exists():
        return
    unfinished.unlink(missing_ok=True)
    dataset, technique = load_joined_set(camera), walks.make_cohog(camera)
    strangers = yield_foreign_places(camera, max(SIZES) - len(dataset.references), base.DATA, list_folders(camera))
    with PlaceMap.create(unfinished, technique.spec) as place_map:
        frames = chain(walks.read_folder_frames(dataset.ref_dir), strangers)
        build_map(frames, FrameEncoder(technique=technique), place_map)
    unfinished.rename(path)


def choose_places(dataset: Dataset, names: list[str], count: int) -> set[str]:
    """Choose the places of a map of `count`: the same first ones at every size (see the top of this file)."""
    rng = np.random.default_rng(0)
    cover = find_cover([query.correct for query in dataset.queries])
    others = [name for name in dataset.references if name not in set(cover)]
    strangers = sorted(set(names) - set(dataset.references))
    for names_of_kind in (others, strangers):
        rng.shuffle(names_of_kind)
    return set([*cover, *others, *strangers][:count])


def find_cover(wanted: list[frozenset[str]]) -> list[str]:
    """Return a few names of which every set has at least one: again and again the one that most sets lack."""
    cover = []
    while wanted:
        counts = Counter(name for names in wanted for name in sorted(names))
        cover.append(max(sorted(counts), key=lambda name: counts[name]))
        wanted = [names for names in wanted if cover[-1] not in names]
    return cover


def copy_places(dataset: Dataset, camera: str, count: int) -> Path:
    """Copy the places of a map of `count` from the map of all, in the same order."""
    path = WORK / f"{camera}_{count}.gpkg"
    path.unlink(missing_ok=True)
    with PlaceMap.open(WORK / f"{camera}.gpkg") as whole:
        names = {place.place_id: place.source_image for place in whole.read_places()}
        chosen = choose_places(dataset, list(names.values()), count)
        with PlaceMap.create(path, whole.spec) as part, part.transaction():
            for entry in check_places(whole):
                if names.get(entry.place_id) in chosen:
                    part.insert(entry.content)
    return path


def measure_map(camera: str, count: int) -> Row:
    """Ask every query in the map of `count` places. `accepted_right` were accepted for a right place, or one of which
    the truth says nothing, `accepted_beside` for one at most two pictures beside a right one, which the truth does not
    count, and `accepted_wrong` for another. `wrong_by` counts the best places that are wrong by where they are: the
    query's own site, another site, or the kind of foreign place. Times are medians and a 90th percentile of the
    processor; `peak_mb` is the highest resident memory of the whole process."""
    dataset, sites = load_joined_set(camera), [folder.name for folder in list_folders(camera)]
    path = copy_places(dataset, camera, count)
    recogniser = open_recogniser(walks.make_config(map=str(path), **{"source.camera": camera}), load_board("this"))
    hits, costs, wrong_by, accepted, neighbours, wrong = [], [], Counter(), 0, 0, []
    with recogniser.place_map as place_map:
        names = walks.read_names(place_map, recogniser.index)
        queries = (dataset.queries[0], *dataset.queries)  # the first pays for tables and a cold disk
        for number, query in enumerate(queries):
            event = recogniser.step(walks.make_frame(query.path))
            ranked = walks.list_ranked_names(event, names)
            if number == 0:
                continue
            counted = next((name for name in ranked if name not in query.ignored), None)
            hits.append(counted in query.correct)
            if counted and not hits[-1]:
                wrong_by[_classify_wrong_place(counted, query.path.name, sites)] += 1
            accepted += event.accepted
            if event.accepted and ranked[0] not in query.correct | query.ignored:
                is_beside = _is_neighbour(ranked[0], query, dataset)
                neighbours += is_beside
                wrong += [] if is_beside else [(query.path.name, ranked[0])]
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
    """Tell whether a place is at most two pictures before or after one that is right, in the order of the site."""
    if place not in dataset.references:
        return False
    right = [dataset.references.index(name) for name in query.correct | query.ignored]
    return min(abs(dataset.references.index(place) - number) for number in right) <= _MAX_NEIGHBOUR_STEPS


def _classify_wrong_place(place: str, query: str, sites: list[str]) -> str:
    """Say where a wrong place is: on the query's own site, on another, or of which kind of foreign places."""
    site = next(name for name in sites if query.startswith(name))
    kind, _, rest = place.rpartition("/")[0].partition("/")
    if kind == MIRRORED_PREFIX:
        return f"{MIRRORED_PREFIX} {'own' if rest.startswith(site) else 'another'} site"
    return kind or ("own site" if place.startswith(site) else "another site")


def format_page(result: Row) -> str:
    """Return the page for people."""
    parts = ["# One map out of many sites", base.strip_title(__doc__, "What is measured")]
    for camera, title in TITLES.items():
        rows = [dict(row) for row in result["rows"] if row["camera"] == camera]
        for row in rows:
            row["where"] = ", ".join(f"{count} {kind}" for kind, count in sorted(row["wrong_by"].items())) or "-"
        parts.append(f"## {title}: {rows[0]['queries']} queries")
        parts += [base.format_table(rows, columns) for columns in (_QUALITY_COLUMNS, _COST_COLUMNS)]
    return "\n\n".join([*parts, base.format_origin(result, "make sites")])


if __name__ == "__main__":
    base.run(main)
