"""Verification by landmarks on every set from the air: writes benchmarks/results/verification.json and verification.md.

python benchmarks/verification.py [--places N]

Every query is asked in the map of every set, with and without verification in turn. A set's own queries show what is
confirmed of the right places, and how far off the middle, the rotation and the scale are; those of the other sets are
of no place of the map, and whatever is confirmed of them is wrong. Truth is pairs_overlap.csv of each set.
"""

import os

import base  # noqa: F401

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import argparse
import csv
import json
import math
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from big_map import make_big_map
from hostile_pictures import camera_of
from run_sets import DATA, RESULTS, made_by

from edgevpr.core.config import load_config
from edgevpr.core.text import markdown
from edgevpr.core.types import Frame
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.level import UNKNOWN_VIEW, Levelled
from edgevpr.frames.source import open_source
from edgevpr.lab.evaluate.dataset import Dataset, load_dataset
from edgevpr.lab.evaluate.evaluate import all_frames, mapped
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.index import bytes_per_place, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import Ranking
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.agreement import CONFIRMED, Agreement
from edgevpr.runtime.recognise.judge import accept_rule
from edgevpr.runtime.recognise.opening import meter_of
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.runtime.recognise.verify import Verification
from edgevpr.techniques import create

LEAST_OVERLAP = 0.3
WIDTH_PX = 640  # of the pictures that the truth was measured in
CONFIG = load_config(None)
Way = tuple[complex, complex]  # turn with scale, and step in shares of the longest side


@dataclass(slots=True, kw_only=True)
class Row:
    """What came of one set. `confirmed` best places have enough landmarks that agree; `accepted` are those without and
    with verification. `by_inliers` counts all places compared with queries of other sets by their inliers. Errors are
    (median, 90th percentile) of the middle in pixels of 640, the rotation in degrees, and the scale as a share."""

    set: str
    right: int = 0
    right_confirmed: int = 0
    right_accepted: list[int] = field(default_factory=lambda: [0, 0])
    wrong: int = 0
    wrong_confirmed: int = 0
    wrong_accepted: list[int] = field(default_factory=lambda: [0, 0])
    foreign: int = 0
    foreign_confirmed: int = 0
    foreign_accepted: list[int] = field(default_factory=lambda: [0, 0])
    by_inliers: dict[int, int] = field(default_factory=dict)
    errors: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)
    t_query_ms: float = 0.0
    t_verify_ms: float = 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--places", type=int, default=10_000, help="of the large map in which times are taken")
    args = parser.parse_args()
    folders = [path.parent for path in sorted(DATA.glob("*/ground_truth.csv"))]
    folders = [folder for folder in folders if camera_of(folder.name) == "nadir"]
    asked = {
        folder.name: [(path.name, read_image(path)) for path in list_images(folder / "query")] for folder in folders
    }
    rows = []
    for folder in folders:
        rows.append(_of_set(folder, asked))
        print(rows[-1], flush=True)
    large = _times_of_large(folders[0], asked[folders[0].name], args.places)
    print(f"{args.places} places: {large}")
    contents = {**made_by(), "sets": [asdict(row) for row in rows], "large_map": {"places": args.places, **large}}
    (RESULTS / "verification.json").write_text(json.dumps(contents, indent=2) + "\n")
    (RESULTS / "verification.md").write_text(_page(rows, args.places, large))


def _of_set(folder: Path, asked: dict[str, list[tuple[str, np.ndarray]]]) -> Row:
    row, truth = Row(set=folder.name), _truth(folder)
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    technique = create("cohog", {"camera": "nadir"})
    off: dict[str, list[tuple[float, float, float]]] = {"vote": [], "landmarks": []}
    chance: Counter[int] = Counter()
    costs = []
    with mapped(_frames(folder), technique, meter_of(CONFIG, load_board("this"))) as (place_map, index):
        walks = [_walk(technique, place_map, index, verify) for verify in (False, True)]
        for name, pictures in asked.items():
            for query, image in pictures:
                events = [walk.step(Frame(image=image, name=query, t_mono_s=0.0)) for walk in walks]
                ranking, accepted = events[1].ranking, [event.accepted for event in events]
                if ranking is None:
                    continue
                if events[1].proof:
                    costs.append((events[1].cost.whole.wall_s, events[1].steps.verify.wall_s))
                of_all = _proofs(walks[1], image, ranking)
                proof = next(of_all)
                confirmed = proof.is_expected and proof.inliers >= CONFIRMED
                if name != folder.name:
                    _count(row, "foreign", confirmed, accepted)
                    chance.update(each.inliers for each in (proof, *of_all) if each.is_expected)
                elif kind := _kind(dataset, query, events[1]):
                    _count(row, kind, confirmed, accepted)
                    true = truth.get((query, events[1].best.place.source_image))
                    if kind == "right" and confirmed and true:
                        match = events[1].best.match
                        cells = technique.spec.parameters["w1"] / technique.spec.parameters["w2"]
                        turn = np.exp(1j * math.radians(match.rotation_deg))
                        off["vote"].append(_off((turn, complex(*match.shift_cells) / cells), true))
                        turn = proof.scale * np.exp(1j * math.radians(proof.rotation_deg))
                        off["landmarks"].append(_off((turn, complex(*proof.shift_share)), true))
    row.by_inliers = dict(sorted(chance.items()))
    row.errors = {who: _summary(errors) for who, errors in off.items()}
    row.t_query_ms, row.t_verify_ms = (1000 * float(np.median(each)) for each in zip(*costs, strict=True))
    return row


def _frames(folder: Path) -> Iterator[Frame]:
    return all_frames(open_source(str(folder / "ref"), live=False))


def _walk(technique, place_map, index, verify: bool) -> Recogniser:
    return Recogniser(
        technique=technique,
        place_map=place_map,
        index=index,
        rule=accept_rule(technique, CONFIG.match),
        meter=meter_of(CONFIG, load_board("this")),
        candidates=technique.candidates,
        verify=verify,
    )


def _proofs(walk: Recogniser, image: np.ndarray, ranking: Ranking) -> Iterator[Agreement]:
    """Hold the query against every place that it was compared with in full, best first."""
    looked = Verification(walk.technique.spec, Levelled(image, None, UNKNOWN_VIEW), walk.index, walk.place_map)
    for slot in ranking.slots.tolist():
        if slot in ranking.compared:
            yield looked.proof(replace(ranking, slots=np.array([slot])))


def _kind(dataset: Dataset, query: str, event: Recognition) -> str | None:
    for each in dataset.queries:
        if each.path.name == query:
            found = event.best.place.source_image
            return "right" if found in each.right else None if found in each.ignored else "wrong"
    return None


def _count(row: Row, kind: str, confirmed: bool, accepted: list[bool]) -> None:
    setattr(row, kind, getattr(row, kind) + 1)
    setattr(row, f"{kind}_confirmed", getattr(row, f"{kind}_confirmed") + confirmed)
    for at, each in enumerate(accepted):
        getattr(row, f"{kind}_accepted")[at] += each


def _truth(folder: Path) -> dict[tuple[str, str], Way]:
    """Return how the first picture of each pair lies on the second, for the pairs that overlap enough."""
    ways = {}
    with (folder / "pairs_overlap.csv").open() as file:
        for pair in csv.DictReader(file):
            if float(pair["overlap"]) >= LEAST_OVERLAP:
                turn = float(pair["scale"]) * np.exp(1j * math.radians(float(pair["rotation_deg"])))
                step = complex(float(pair["dx_px"]), float(pair["dy_px"])) / WIDTH_PX
                ways[pair["file_a"], pair["file_b"]] = turn, step
                ways[pair["file_b"], pair["file_a"]] = 1 / turn, -step / turn
    return ways


def _off(found: Way, true: Way) -> tuple[float, float, float]:
    """Return how far off the middle (pixels), the rotation (degrees) and the scale (a share) are."""
    beside = found[0] / true[0]
    return (
        WIDTH_PX * abs(found[1] - true[1]),
        abs(math.degrees(np.angle(beside))),
        abs(math.log(abs(beside))),
    )


def _summary(errors: list[tuple[float, float, float]]) -> dict[str, tuple[float, float]]:
    names = ("middle_px", "rotation_deg", "scale")
    columns = zip(names, zip(*errors, strict=True), strict=True)
    return {name: tuple(np.quantile(column, (0.5, 0.9)).round(3).tolist()) for name, column in columns}


def _times_of_large(folder: Path, asked: list[tuple[str, np.ndarray]], places: int) -> dict[str, float]:
    """Map a set behind `places` places of random content, and return the times of a query and of its verification."""
    technique, meter = create("cohog", {"camera": "nadir"}), meter_of(CONFIG, load_board("this"))
    with tempfile.TemporaryDirectory(prefix="edgevpr-verification-") as temporary:
        path = Path(temporary) / "large.gpkg"
        make_big_map(path, technique.spec, places)
        with PlaceMap.open_for_adding(path) as place_map:
            build_map(_frames(folder), technique, place_map, meter)
        with PlaceMap.open(path) as place_map:
            index = load_index(place_map, technique, len(place_map) * bytes_per_place(technique.spec))
            walks = [_walk(technique, place_map, index, verify) for verify in (False, True)]
            events = [
                [walk.step(Frame(image=image, name=query, t_mono_s=0.0)) for walk in walks] for query, image in asked
            ]
    taken = [
        [without.cost.whole.wall_s, found.cost.whole.wall_s, found.steps.verify.wall_s]
        for without, found in events
        if found.proof
    ]
    without, whole, verify = 1000 * np.median(taken, axis=0)
    return {"t_query_without_ms": without, "t_query_ms": whole, "t_verify_ms": verify}


def _page(rows: list[Row], places: int, large: dict[str, float]) -> str:
    header = [
        "set", "right best places", "confirmed", "accepted, without and with", "wrong, of these and of other sets",
        "confirmed", "accepted, without and with", "middle off, vote", "middle off, landmarks", "rotation off, vote",
        "rotation off, landmarks", "scale off, landmarks", "of a query",
    ]  # fmt: skip
    cells = []
    for row in rows:
        vote, found = row.errors["vote"], row.errors["landmarks"]
        wrong_accepted = [own + other for own, other in zip(row.wrong_accepted, row.foreign_accepted, strict=True)]
        cells.append(
            [
                row.set,
                str(row.right),
                str(row.right_confirmed),
                " ".join(map(str, row.right_accepted)),
                f"{row.wrong} + {row.foreign}",
                f"{row.wrong_confirmed} + {row.foreign_confirmed}",
                " ".join(map(str, wrong_accepted)),
                "{:.1f} / {:.1f}".format(*vote["middle_px"]),
                "{:.1f} / {:.1f}".format(*found["middle_px"]),
                "{:.1f} / {:.1f}".format(*vote["rotation_deg"]),
                "{:.1f} / {:.1f}".format(*found["rotation_deg"]),
                "{:.1%} / {:.1%}".format(*found["scale"]),
                f"{row.t_verify_ms:.0f} of {row.t_query_ms:.0f} ms",
            ]
        )
    chance = sum((Counter(row.by_inliers) for row in rows), Counter())
    counts = ", ".join(f"{chance[inliers]} with {inliers}" for inliers in sorted(chance))
    return (
        "# Verification by landmarks\n\n"
        "Made by `python benchmarks/verification.py`. A best place is confirmed when "
        f"{CONFIRMED} or more of its landmarks agree as the displacement vote says that it lies. Errors are the median "
        "and the 90th percentile, of the confirmed right places whose overlap is known: the middle in pixels of 640, "
        "the rotation in degrees. Limits were chosen on aerial_caliterra and aerial_garfield28, and the number of "
        "landmarks that proves a place on the pairs of all sets that show different ground.\n\n"
        f"{markdown(header, cells)}\n\n"
        f"Places compared with queries of other sets, by how many of their landmarks agree: {counts}.\n\n"
        f"In a map of {places} places more, a query takes {large['t_query_ms']:.0f} ms, {large['t_verify_ms']:.0f} of "
        f"them to verify; without verification {large['t_query_without_ms']:.0f}.\n"
    )


if __name__ == "__main__":
    main()
