"""One map out of many sites, as it grows to ten thousand places: `make sites`.

All sets from the air are one map looking down, and corridor and grief_stromovka_seasons one looking ahead. Each query
asks for its place among all of them, as in a flight that knows nothing of where it is. The maps are nested: first a
right place for every query (as few as that takes), then the other pictures of the sites, then places that are nowhere
near (`foreign_places.py`), in equal mixture at every size. So up to the size that is marked as all sites, right places
come in too; from there on only foreign ones do.

Places have no positions: the confidence is the shipped one, and looking down landmarks tell which places show the same
ground. Each map is asked in a process of its own, one thread. Times are of the processor. Beside that all places are
compared in full, which no flight has time for: looking ahead, in the map of 200, for every third query.
Looking down, a third of the foreign places is mirrored ground of the very sites; a map of others only stands beside.

What is measured stays in the folder --work, so that an interrupted run goes on.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import sites_page
from foreign_places import MIRRORED, foreign
from run_sets import FROM_THE_AIR, find_sets, join, parser_of

from edgevpr.core.config import load_config
from edgevpr.core.errors import EdgevprError
from edgevpr.core.types import Frame
from edgevpr.frames.images import read_image
from edgevpr.frames.source import open_source
from edgevpr.lab.evaluate.dataset import Dataset, ScoredQuery, load_dataset
from edgevpr.lab.evaluate.evaluate import all_frames
from edgevpr.lab.evaluate.metrics import interval
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.examine import examine
from edgevpr.places.index import bytes_per_place
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import meter_of, open_recogniser
from edgevpr.techniques import create

SIZES = (50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000)
AHEAD = ("corridor", "grief_stromovka_seasons")  # the sets that look ahead and are large enough to be asked
EXACT_PLACES, EXACT_EVERY = 200, 3  # every third query
UNLIKE, UNLIKE_PLACES = "unlike", 5_000
_BESIDE = 2  # pictures, as where a map has no positions


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The result of all queries in one map. `how` is flown, exact (all places compared in full), or unlike (flown, and
    no mirrored picture is in the map). `hits` has a + for each query whose best place is right. `accepted_right` were
    accepted for a right place, or one of which the truth says nothing, `accepted_beside` for one at most two pictures
    beside a right one, which the truth does not count, and `accepted_wrong` for another. `wrong_by` counts the best
    places that are wrong by where they are: the query's own site, another site, or the kind of foreign place. Times are
    medians and a 90th percentile of the processor; `peak_mb` is the highest resident memory (VmHWM) of the whole
    process."""

    camera: str
    places: int
    of_sites: int
    how: str
    queries: int
    hits: str
    recall_at_1: float
    recall_at_1_interval: tuple[float, float] | None
    accepted_right: int
    accepted_beside: int
    accepted_wrong: int
    wrong_by: dict[str, int]
    accepted_wrong_names: list[tuple[str, str]]
    t_encode_ms: float
    t_scan_ms: float
    t_query_ms: float
    t_query_p90_ms: float
    bytes_per_place: int
    row_bytes: int
    peak_mb: float
    map_mb: float


def main() -> int:
    parser = parser_of(__doc__, "sites_work")
    parser.add_argument("--measure", nargs=3, metavar=("CAMERA", "PLACES", "HOW"), help="one map, in this process")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    try:
        args.work.mkdir(parents=True, exist_ok=True)
        if args.measure:
            camera, places, how = args.measure
            row = measured(args.work, args.data, camera, int(places), how)
            path = args.work / f"{camera}_{places}_{how}.json"
            path.with_suffix(".new").write_text(json.dumps(asdict(row)))
            path.with_suffix(".new").replace(path)
            return 0
        rows = []
        for camera, places, how in planned(args.work, args.data):
            path = args.work / f"{camera}_{places}_{how}.json"
            if not path.exists():
                flags = ["--data", args.data, "--work", args.work, "--measure", camera, places, how]
                subprocess.run([sys.executable, __file__, *map(str, flags)], check=True)
                print(path.read_text(), flush=True)
            rows.append(json.loads(path.read_text()))
            sites_page.write(args.out, rows, __doc__)
    except EdgevprError as error:
        print(f"sites: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def planned(work: Path, data: Path) -> Iterator[tuple[str, int, str]]:
    """Yield what is to be measured; the map of all places is built before its camera's first."""
    for camera in sites_page.TITLES:
        dataset, count = dataset_of(work, data, camera), _build(work, data, camera)
        sizes = sorted({size for size in SIZES if size <= count} | {len(dataset.references)})
        yield from ((camera, size, "flown") for size in sizes)
    yield "nadir", UNLIKE_PLACES, UNLIKE
    yield "forward", EXACT_PLACES, "exact"


def folders_of(data: Path, camera: str) -> list[Path]:
    if camera == "forward":
        return find_sets(data, list(AHEAD))
    return [folder for folder in find_sets(data, None) if folder.name.startswith(FROM_THE_AIR)]


def dataset_of(work: Path, data: Path, camera: str) -> Dataset:
    """Return the sets of one camera as one set."""
    joined = work / f"{camera}_sites"
    if not (joined / "ground_truth.csv").exists():
        join(folders_of(data, camera), joined)
    return load_dataset(joined / "query", joined / "ref", joined / "ground_truth.csv")


def _build(work: Path, data: Path, camera: str) -> int:
    """Build the map of all places, or go on with it; return how many it has."""
    dataset, path = dataset_of(work, data, camera), work / f"{camera}.gpkg"
    technique, config = create("cohog", {"camera": camera}), load_config(None)
    with PlaceMap.open_for_adding(path) if path.exists() else PlaceMap.create(path, technique.spec) as place_map:
        if len(place_map) < max(SIZES):

            def frames() -> Iterator[Frame]:
                yield from all_frames(open_source(str(dataset.ref_dir), live=False))
                missing = max(SIZES) - len(dataset.references)
                yield from foreign(camera, missing, data, folders_of(data, camera))

            build_map(frames(), technique, place_map, meter_of(config, load_board("this")))
        return len(place_map)


def chosen(dataset: Dataset, names: list[str], count: int) -> set[str]:
    """Choose the places of a map of `count`: the same first ones at every size (see the top of this file)."""
    rng = np.random.default_rng(0)
    cover = covering([query.right for query in dataset.queries])
    others = [name for name in dataset.references if name not in set(cover)]
    strangers = sorted(set(names) - set(dataset.references))
    for each in (others, strangers):
        rng.shuffle(each)
    return set([*cover, *others, *strangers][:count])


def covering(wanted: list[frozenset[str]]) -> list[str]:
    """Return a few names of which every set has at least one: again and again the one that most sets lack."""
    cover = []
    while wanted:
        counts = Counter(name for names in wanted for name in sorted(names))
        cover.append(max(sorted(counts), key=lambda name: counts[name]))
        wanted = [names for names in wanted if cover[-1] not in names]
    return cover


def part_of(work: Path, dataset: Dataset, camera: str, count: int, how: str) -> Path:
    """Copy the places of a map of `count` from the map of all, in the same order."""
    path = work / f"{camera}_{count}_{how}.gpkg"
    path.unlink(missing_ok=True)
    with PlaceMap.open(work / f"{camera}.gpkg") as whole:
        names = {place.place_id: place.source_image for place in whole.places()}
        may_be = [name for name in names.values() if how != UNLIKE or not name.startswith(MIRRORED)]
        kept = chosen(dataset, may_be, count)
        with PlaceMap.create(path, whole.spec) as part, part.transaction():
            for each in examine(whole):
                if names.get(each.place_id) in kept:
                    part.insert(each.content)
    return path


def measured(work: Path, data: Path, camera: str, count: int, how: str) -> Row:
    """Ask every query in the map of `count` places."""
    dataset = dataset_of(work, data, camera)
    path = part_of(work, dataset, camera, count, how)
    config = load_config(None, {"map": str(path), "source.camera": camera})
    recogniser = open_recogniser(config, load_board("this"))
    if how == "exact":
        recogniser.candidates = None
    sites = [folder.name for folder in folders_of(data, camera)]
    hits, costs, wrong_by, accepted, beside, wrong = [], [], Counter(), 0, [], []
    queries = dataset.queries[::EXACT_EVERY] if how == "exact" else dataset.queries
    with recogniser.place_map as place_map:
        name_of = {place.place_id: place.source_image for place in place_map.places()}
        names = [name_of[place_id] for place_id in recogniser.index.place_ids.tolist()]
        for number, query in enumerate((queries[0], *queries)):  # the first pays for tables and a cold disk
            event = recogniser.step(Frame(image=read_image(query.path), name=query.path.name, t_mono_s=0.0))
            if event.failed:
                raise EdgevprError(event.reason)
            if number == 0:
                continue
            ranked = [names[slot] for slot in event.ranking.slots] if event.ranking else []
            counted = next((name for name in ranked if name not in query.ignored), None)
            hits.append(counted in query.right)
            if counted and not hits[-1]:
                wrong_by[_whereabouts(counted, query.path.name, sites)] += 1
            accepted += event.accepted
            if event.accepted and ranked[0] not in query.right | query.ignored:
                is_beside = _is_beside(ranked[0], query, dataset)
                (beside if is_beside else wrong).append((query.path.name, ranked[0]))
            costs.append((event.steps.encode.cpu_s, event.steps.scan.cpu_s, event.cost.cpu_s))
        peak_mb = _peak_mb()
    t_encode_ms, t_scan_ms, t_query_ms = (1000 * np.median(costs, axis=0)).round(2).tolist()
    spec = recogniser.technique.spec
    row = Row(
        camera=camera,
        places=len(recogniser.index),
        of_sites=sum(name in set(dataset.references) for name in names),
        how=how,
        queries=len(hits),
        hits="".join("-+"[hit] for hit in hits),
        recall_at_1=round(float(np.mean(hits)), 4),
        recall_at_1_interval=interval(np.array(hits)),
        accepted_right=int(accepted) - len(beside) - len(wrong),
        accepted_beside=len(beside),
        accepted_wrong=len(wrong),
        wrong_by=dict(wrong_by),
        accepted_wrong_names=wrong,
        t_encode_ms=t_encode_ms,
        t_scan_ms=t_scan_ms,
        t_query_ms=t_query_ms,
        t_query_p90_ms=round(1000 * float(np.percentile([each[2] for each in costs], 90)), 1),
        bytes_per_place=bytes_per_place(spec),
        row_bytes=spec.row.nbytes,
        peak_mb=round(peak_mb, 1),
        map_mb=round(path.stat().st_size / 1e6, 1),
    )
    path.unlink()
    return row


def _is_beside(place: str, query: ScoredQuery, dataset: Dataset) -> bool:
    """Tell whether a place is at most two pictures before or after one that is right, in the order of the site."""
    if place not in dataset.references:
        return False
    known = [dataset.references.index(name) for name in query.right | query.ignored]
    return min(abs(dataset.references.index(place) - at) for at in known) <= _BESIDE


def _whereabouts(place: str, query: str, sites: list[str]) -> str:
    """Say where a wrong place is: on the query's own site, on another, or of which kind of foreign places."""
    own = next(name for name in sites if query.startswith(name))
    kind, _, rest = place.rpartition("/")[0].partition("/")
    if kind == MIRRORED:
        return f"{MIRRORED} {'own' if rest.startswith(own) else 'another'} site"
    return kind or ("own site" if place.startswith(own) else "another site")


def _peak_mb() -> float:
    status = Path("/proc/self/status").read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM:")) * 1024 / 1e6


if __name__ == "__main__":
    sys.exit(main())
