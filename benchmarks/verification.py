"""Verification by landmarks on every set from the air: writes benchmarks/results/verification.json and verification.md.

Every query is asked in the map of every set, with and without verification in turn. A set's own queries show what is
confirmed of the right places, and how far off the middle, the rotation and the scale are; those of the other sets are
of no place of the map, and whatever is confirmed of them is wrong. Truth is pairs_overlap.csv of each set.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import base
import numpy as np
import walks
from base import Row

from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.level import UNKNOWN_VIEW, Levelled
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.places.retrieve import Ranking
from edgevpr.runtime.recognise.agreement import CONFIRMED, Agreement, Verification
from edgevpr.runtime.recognise.judge import accept_rule
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition

LEAST_OVERLAP = 0.3
WIDTH_PX = 640  # of the pictures that the truth was measured in
Way = tuple[complex, complex]  # turn with scale, and step in shares of the longest side
Pictures = list[tuple[str, np.ndarray]]
_KINDS = ("right", "wrong", "foreign")
_COLUMNS = {
    "set": "{set}",
    "right best places": "{right}",
    "confirmed": "{right_confirmed}",
    "accepted, without and with": "{right_accepted[0]} {right_accepted[1]}",
    "wrong, of these and of other sets": "{wrong} + {foreign}",
    "confirmed ": "{wrong_confirmed} + {foreign_confirmed}",
    "accepted, without and with ": "{others_accepted[0]} {others_accepted[1]}",
    "middle off, vote": "{errors[vote][middle_px][0]:.1f} / {errors[vote][middle_px][1]:.1f}",
    "middle off, landmarks": "{errors[landmarks][middle_px][0]:.1f} / {errors[landmarks][middle_px][1]:.1f}",
    "rotation off, vote": "{errors[vote][rotation_deg][0]:.1f} / {errors[vote][rotation_deg][1]:.1f}",
    "rotation off, landmarks": "{errors[landmarks][rotation_deg][0]:.1f} / {errors[landmarks][rotation_deg][1]:.1f}",
    "scale off, landmarks": "{errors[landmarks][scale][0]:.1%} / {errors[landmarks][scale][1]:.1%}",
    "of a query": "{t_verify_ms:.0f} of {t_query_ms:.0f} ms",
}


def main() -> None:
    folders, found = base.registered(), {**base.made_by(), "sets": []}
    asked = {each.name: [(path.name, read_image(path)) for path in list_images(each / "query")] for each in folders}
    for folder in folders:
        found["sets"].append(_of_set(folder, asked))
    base.write("verification", found, page(found))


def _of_set(folder: Path, asked: dict[str, Pictures]) -> Row:
    """Ask all queries in the map of a set. `confirmed` best places have enough landmarks that agree; `accepted` are
    those without and with verification. `by_inliers` counts all places compared with queries of other sets by their
    inliers. Errors are (median, 90th percentile) of the middle in pixels of 640, the rotation in degrees, and the scale
    as a share."""
    row: Row = {"set": folder.name}
    for kind in _KINDS:
        row |= {kind: 0, f"{kind}_confirmed": 0, f"{kind}_accepted": [0, 0]}
    truth, dataset = _truth(folder), walks.dataset_of(folder)
    off: dict[str, list[tuple[float, float, float]]] = {"vote": [], "landmarks": []}
    chance: Counter[int] = Counter()
    costs = []
    with walks.map_of(folder) as (place_map, index, technique):
        rule = accept_rule(technique, walks.config().match)
        both = [walks.walk(place_map, index, technique, rule=rule, verify=verify) for verify in (False, True)]
        for name, query, image in ((name, *each) for name, pictures in asked.items() for each in pictures):
            events = [walk.step(walks.frame(image, query)) for walk in both]
            ranking, accepted = events[1].ranking, [event.accepted for event in events]
            if ranking is None:
                continue
            if events[1].proof:
                costs.append((events[1].cost.whole.wall_s, events[1].steps.verify.wall_s))
            of_all = _proofs(both[1], image, ranking)
            proof = next(of_all)
            confirmed = proof.is_expected and proof.inliers >= CONFIRMED
            kind = "foreign" if name != folder.name else _kind(dataset, query, events[1])
            if kind:
                row[kind] += 1
                row[f"{kind}_confirmed"] += confirmed
                row[f"{kind}_accepted"] = [sum(each) for each in zip(row[f"{kind}_accepted"], accepted, strict=True)]
            if kind == "foreign":
                chance.update(each.inliers for each in (proof, *of_all) if each.is_expected)
            true = truth.get((query, events[1].best.place.source_image)) if kind == "right" and confirmed else None
            if true:
                match = events[1].best.match
                cells = technique.spec.parameters["w1"] / technique.spec.parameters["w2"]
                turn = np.exp(1j * math.radians(match.rotation_deg))
                off["vote"].append(_off((turn, complex(*match.shift_cells) / cells), true))
                turn = proof.scale * np.exp(1j * math.radians(proof.rotation_deg))
                off["landmarks"].append(_off((turn, complex(*proof.shift_share)), true))
    t_query_ms, t_verify_ms = (1000 * np.median(costs, axis=0)).tolist()
    row |= {"by_inliers": {str(count): chance[count] for count in sorted(chance)}}
    names = ("middle_px", "rotation_deg", "scale")
    both_ends = {who: np.quantile(errors, (0.5, 0.9), axis=0).round(3).T.tolist() for who, errors in off.items()}
    row |= {"errors": {who: dict(zip(names, ends, strict=True)) for who, ends in both_ends.items()}}
    return row | {"t_query_ms": t_query_ms, "t_verify_ms": t_verify_ms}


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


def _truth(folder: Path) -> dict[tuple[str, str], Way]:
    """Return how the first picture of each pair lies on the second, for the pairs that overlap enough."""
    ways = {}
    for pair in base.read_csv(folder / "pairs_overlap.csv"):
        if float(pair["overlap"]) >= LEAST_OVERLAP:
            turn = float(pair["scale"]) * np.exp(1j * math.radians(float(pair["rotation_deg"])))
            step = complex(float(pair["dx_px"]), float(pair["dy_px"])) / WIDTH_PX
            ways[pair["file_a"], pair["file_b"]] = turn, step
            ways[pair["file_b"], pair["file_a"]] = 1 / turn, -step / turn
    return ways


def _off(found: Way, true: Way) -> tuple[float, float, float]:
    """Return how far off the middle (pixels), the rotation (degrees) and the scale (a share) are."""
    beside = found[0] / true[0]
    return WIDTH_PX * abs(found[1] - true[1]), abs(np.degrees(np.angle(beside))), abs(np.log(abs(beside)))


def page(found: Row) -> str:
    """Return the page for people."""
    rows = found["sets"]
    for row in rows:
        accepted = zip(row["wrong_accepted"], row["foreign_accepted"], strict=True)
        row["others_accepted"] = [own + other for own, other in accepted]
    chance = sum((Counter(row["by_inliers"]) for row in rows), Counter())
    counts = ", ".join(f"{chance[inliers]} with {inliers}" for inliers in sorted(chance, key=int))
    return f"""# Verification by landmarks

Made by `python benchmarks/verification.py`. A best place is confirmed when {CONFIRMED} or more of its landmarks agree
as the displacement vote says that it lies. Errors are the median and the 90th percentile, of the confirmed right places
whose overlap is known: the middle in pixels of 640, the rotation in degrees. Limits were chosen on aerial_caliterra and
aerial_garfield28, and the number of landmarks that proves a place on the pairs of all sets that show different ground.

{base.table(rows, _COLUMNS)}

Places compared with queries of other sets, by how many of their landmarks agree: {counts}.
"""


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
