"""What memorable maps are worth: every image set with and without the gate.

python benchmarks/bench_salience.py [--sets A,B]

Needs the extra `train`, and for the staticity a detector (see `detectors`). For every set the network of matchability
is fitted to all other sites, so that no figure comes from a network that has seen its site. Writes salience.json
and salience.md into benchmarks/results/.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import base
import cv2
import detectors
import numpy as np
import walks
from base import DATA, Row, camera_of
from train_matchability import NOT_LEARNT, fit, label_site, leave_one_out, site_of, write_network

from edgevpr.core.config import load_config
from edgevpr.core.text import progress
from edgevpr.core.types import Salience
from edgevpr.frames.images import list_images, read_image
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.runtime.recognise.gate_networks import Detector, Memorability
from edgevpr.runtime.recognise.salience_gate import compute_scores, judge_scores
from edgevpr.techniques.card import load_card

TECHNIQUES = ("hog", "cohog", "calc", "netvlad")
OFF = replace(load_config(None).salience, memorability=0.0, staticity=0.0, entropy=0.0)
FULL = replace(OFF, memorability=0.3, staticity=0.6, entropy=0.4)
GATES = {
    "none": OFF,
    "all three": FULL,
    "memorability": replace(OFF, memorability=FULL.memorability),
    "staticity": replace(OFF, staticity=FULL.staticity),
    "entropy": replace(OFF, entropy=FULL.entropy),
}
SAME_SITE = {"grief_stromovka_monthly": "grief_stromovka_seasons"}
_SEED = 1
# The answer to a query: the slots of the places, best first, their scores, and which slots are right or to be ignored.
Answer = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", metavar="A,B", help="(default: all)")
    args = parser.parse_args()
    names = args.sets.split(",") if args.sets else None
    folders = base.find_sets(names=names)
    with tempfile.TemporaryDirectory(prefix="edgevpr-salience-") as temporary:
        os.environ["EDGEVPR_MODELS"] = temporary
        judged = fit_each([each.name for each in folders], Path(temporary))
        there = [detectors.NAME] if detectors.is_there() else []
        if there:
            detectors.write_card(Path(temporary))
        detector = Detector(load_card(detectors.NAME)) if there else None
        speed = speeds(f"without_{folders[0].name}", there)
        rows = []
        for folder in folders:
            memorability = Memorability(load_card(f"without_{folder.name}"))
            dataset = walks.dataset_of(folder)
            queries = [each.path for each in dataset.queries]
            places = list_images(folder / "ref")
            every = progress([*queries, *places], len(queries) + len(places), f"{folder.name}: salience")
            seen = {path: scores_by_gate(path, memorability, detector) for path in every}
            kept = _kept(places, seen)
            for technique in TECHNIQUES:
                asked = ask(technique, dataset)
                rows += gated(folder.name, technique, asked, [seen[path] for path in queries], kept)
    found = {**base.made_by(), "speed": speed, "unseen": judged, "gate": rows}
    base.write("salience", found, page(found))


def fit_each(names: list[str], models: Path) -> dict[str, dict[str, float | None]]:
    """For every set fit a network to all other sites, and write it with its card; return how it does on sites that it
    has not seen, on generated changes and on real queries."""
    learnt = [folder for folder in base.find_sets() if folder.name not in NOT_LEARNT]
    sites = [site_of(each.name, label_site(each, camera_of(each.name) == "nadir", _SEED)) for each in learnt]
    for name in names:
        network = fit([site for site in sites if site.name not in (name, SAME_SITE.get(name))], _SEED)
        write_network(network, models / f"without_{name}.onnx", f"without {name}", "a benchmark", sites[0])
    return leave_one_out(sites, _SEED)


def speeds(network: str, there: list[str]) -> dict[str, float]:
    """Return the median milliseconds of a frame of 640x480, one thread."""
    picture = cv2.resize(read_image(list_images(DATA / "aerial_swindale" / "ref")[0]), (640, 480))
    memorability = Memorability(load_card(network))
    found = {name: Detector(load_card(name)) for name in there}
    ways = {
        "entropy": lambda: compute_scores(picture),
        "entropy and memorability": lambda: compute_scores(picture, memorability),
    }
    for name, each in found.items():
        ways[f"all three, {name}"] = lambda each=each: compute_scores(picture, memorability, each.is_static(picture))
    times_ms: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(31):  # in turn, so that a busy moment hits all of them; the first round only warms
        for name, way in ways.items():
            start = time.perf_counter()
            way()
            times_ms[name].append(1e3 * (time.perf_counter() - start))
    return {name: float(np.median(each[1:])) for name, each in times_ms.items()}


def ask(name: str, dataset: Dataset) -> list[Answer]:
    """Map the references and ask all queries."""
    site, asked = dataset.ref_dir.parent.name, []
    with walks.walk_over(list_images(dataset.ref_dir), name, camera_of(site) == "nadir") as walk:
        for query in progress(dataset.queries, len(dataset.queries), f"{site}, {name}"):
            ranking = walk.step(walks.frame(query.path)).ranking
            found = (np.empty(0, int), np.empty(0)) if ranking is None else (ranking.slots, ranking.scores)
            of = [np.isin(dataset.references, list(names)) for names in (query.correct, query.ignored)]
            asked.append((*found, *of))
    return asked


def answers(asked: list[Answer], places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Answer every query from the places that are kept, bool (N,): (score of the best, is it right)."""
    best, found = [], []
    for slots, scores, right, ignored in asked:
        counts = places[slots] & ~ignored[slots]
        best.append(float(scores[counts][0]) if counts.any() else 0.0)
        found.append(bool(right[slots[counts][0]]) if counts.any() else False)
    return np.array(best), np.array(found)


def gated(
    name: str, technique: str, asked: list[Answer], seen: list[dict[str, Salience]], kept: dict[str, np.ndarray]
) -> Iterable[Row]:
    """Yield the rows of a technique on a set: without a gate, with all criteria, and with each alone. All references
    stay, as in the thesis. `auc` is that of the thesis's count (a query that is discarded is a true negative),
    `recall_strict` counts it as missed. `true_discarded` of the `queries` were matched rightly without the gate,
    `false_discarded` wrongly. `places` is the share of the references that pass the gate."""
    score, found = answers(asked, np.ones(len(asked[0][2]), bool))
    for gate, thresholds in GATES.items():
        passes = np.array([judge_scores(each[gate], thresholds).reason is None for each in seen])
        precision, recall = metrics.precision_recall(score[passes], found[passes])
        yield {
            "set": name,
            "technique": technique,
            "gate": gate,
            "recall": float(found[passes].mean()) if passes.any() else 0.0,
            "auc": float(metrics.auc_2_3(precision, recall)) if passes.any() else 0.0,
            "recall_strict": float((found & passes).mean()),
            "queries": len(passes),
            "true_discarded": int((found & ~passes).sum()),
            "false_discarded": int((~found & ~passes).sum()),
            "places": float(kept[gate].mean()),
        }


def scores_by_gate(path: Path, memorability: Memorability, detector: Detector | None) -> dict[str, Salience]:
    """Return the scores of a picture under each gate. A criterion alone knows nothing of what moves, but staticity."""
    picture = read_image(path)
    still = compute_scores(picture, memorability)
    if detector is None:
        return dict.fromkeys(GATES, still)
    moving = compute_scores(picture, memorability, detector.is_static(picture))
    return {gate: moving if gate in ("all three", "staticity") else still for gate in GATES}


def _kept(places: list[Path], seen: dict[Path, dict[str, Salience]]) -> dict[str, np.ndarray]:
    """Return which references pass each gate."""
    return {
        gate: np.array([judge_scores(seen[path][gate], thresholds).reason is None for path in places])
        for gate, thresholds in GATES.items()
    }


_GATE = {
    "set": "{set}",
    "technique": "{technique}",
    "gate": "{gate}",
    "recall": "{recall:.2f}",
    "AUC": "{auc:.2f}",
    "strict": "{recall_strict:.2f}",
    "right": "{true_discarded}",
    "wrong": "{false_discarded}",
}


def page(found: Row) -> str:
    """Return the page for people."""
    rows = found["gate"]
    told = [{"pictures": of, **by_site} for of, by_site in found["unseen"].items()]
    columns = {"pictures": "{pictures}", **{name: f"{{{name}:.2f}}" for name in list(told[0])[1:]}}
    discards = {(row["set"], row["technique"]) for row in rows if row["true_discarded"] or row["false_discarded"]}
    sets = list(dict.fromkeys(row["set"] for row in rows))
    unchanged = [name for name in sets if not any(each == name for each, _ in discards)]
    shares = {(row["gate"], row["set"]): row["places"] for row in rows}
    speed = [{"what": what, "ms": t_ms} for what, t_ms in found["speed"].items()]
    sizes = [{"gate": gate, **{name: shares[gate, name] for name in sets}} for gate in GATES if gate != "none"]
    return f"""# Memorable maps: what the gate and the choice of places are worth

Made by `python benchmarks/bench_salience.py`, {found["date"]}, commit {found["commit"]}, {found["machine"]["cpu"]}.
Thresholds: memorability {FULL.memorability:g}, staticity {FULL.staticity:g}, entropy {FULL.entropy:g}.

## Time of a frame of 640x480, one thread

{base.table(speed, {"what": "{what}", "ms": "{ms:.1f}"})}

## Is it told which frames are found again? On sites that were left out; 0.50 is chance

{base.table(told, columns)}

## With and without the gate

recall@1 and AUC are those of the thesis's count: a query that is discarded is a true negative. *strict*: it is a miss.
*right* and *wrong* count the discarded queries that would have been matched so. The map has all references. No query is
discarded of
{", ".join(unchanged) or "any set"}: there all figures are those without a gate.

{base.table([row for row in rows if (row["set"], row["technique"]) in discards], _GATE)}

The size of a map that is built through the gate, before its gaps are filled: share of the references kept

{base.table(sizes, {"gate": "{gate}", **{name: f"{{{name}:.0%}}" for name in sets}})}

"""


if __name__ == "__main__":
    base.run(main)
