"""Measure the salience gate: match every image set with and without it.

python benchmarks/bench_salience.py [--sets A,B]

Needs the extra `train`, and a detector for the staticity (see `detectors`). For every set, the memorability network is
fitted to all other sites, so that no figure comes from a network that has seen the site. Writes salience.json and
salience.md into benchmarks/results/.
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
from base import DATA, Row, infer_camera
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
NO_GATE = replace(load_config(None).salience, memorability=0.0, staticity=0.0, entropy=0.0)
FULL_GATE = replace(NO_GATE, memorability=0.3, staticity=0.6, entropy=0.4)
GATES = {
    "none": NO_GATE,
    "all three": FULL_GATE,
    "memorability": replace(NO_GATE, memorability=FULL_GATE.memorability),
    "staticity": replace(NO_GATE, staticity=FULL_GATE.staticity),
    "entropy": replace(NO_GATE, entropy=FULL_GATE.entropy),
}
SAME_SITE = {"grief_stromovka_monthly": "grief_stromovka_seasons"}
_SEED = 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", metavar="A,B", help="sets to match, comma-separated (default: all)")
    args = parser.parse_args()
    names = args.sets.split(",") if args.sets else None
    folders = base.find_sets(names=names)
    with tempfile.TemporaryDirectory(prefix="edgevpr-salience-") as temporary:
        os.environ["EDGEVPR_MODELS"] = temporary
        unseen = fit_networks([folder.name for folder in folders], Path(temporary))
        detector = None
        if detectors.FILE.is_file():
            detectors.install_detector(Path(temporary))
            detector = Detector(load_card(detectors.NAME))
        speed = measure_frame_times_ms(f"without_{folders[0].name}", detector)
        rows = []
        for folder in folders:
            memorability = Memorability(load_card(f"without_{folder.name}"))
            dataset = walks.load_matched_set(folder)
            queries = [query.path for query in dataset.queries]
            places = list_images(folder / "ref")
            paths = progress([*queries, *places], len(queries) + len(places), f"{folder.name}: salience")
            scores = {path: compute_scores_by_gate(path, memorability, detector) for path in paths}
            kept = {gate: find_passing([scores[path] for path in places], gate) for gate in GATES}
            for technique in TECHNIQUES:
                answers = answer_queries(technique, dataset)
                rows += measure_gates(folder.name, technique, *answers, [scores[path] for path in queries], kept)
    result = {**base.describe_run(), "speed": speed, "unseen": unseen, "gate": rows}
    base.write("salience", result, format_page(result))


def fit_networks(names: list[str], models: Path) -> dict[str, dict[str, float | None]]:
    """For every set, fit a network to all other sites, and write it with its card. Returns the ROC AUC on each site
    that was left out, on `generated` changes and on `real` queries."""
    learnt = [folder for folder in base.find_sets() if folder.name not in NOT_LEARNT]
    sites = [site_of(folder.name, label_site(folder, infer_camera(folder.name) == "nadir", _SEED)) for folder in learnt]
    for name in names:
        network = fit([site for site in sites if site.name not in (name, SAME_SITE.get(name))], _SEED)
        write_network(network, models / f"without_{name}.onnx", f"without {name}", "a benchmark", sites[0])
    return leave_one_out(sites, _SEED)


def measure_frame_times_ms(network: str, detector: Detector | None) -> dict[str, float]:
    """Return the median time (ms) of the criteria on a frame of 640x480, one thread."""
    picture = cv2.resize(read_image(list_images(DATA / "aerial_swindale" / "ref")[0]), (640, 480))
    memorability = Memorability(load_card(network))
    methods = {
        "entropy": lambda: compute_scores(picture),
        "entropy and memorability": lambda: compute_scores(picture, memorability),
    }
    if detector:
        name = f"all three, {detectors.NAME}"
        methods[name] = lambda: compute_scores(picture, memorability, detector.is_static(picture))
    times_ms: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(31):  # in turn, so that a busy moment affects all; the first round is a warm-up
        for name, method in methods.items():
            start = time.perf_counter()
            method()
            times_ms[name].append(1e3 * (time.perf_counter() - start))
    return {name: float(np.median(values_ms[1:])) for name, values_ms in times_ms.items()}


def answer_queries(name: str, dataset: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Map the references with a technique, and match all queries. Returns the score of the best place that is not
    ignored, and whether it is right, for each query, (Q,) each."""
    site, best_scores, is_right = dataset.ref_dir.parent.name, [], []
    with walks.open_walk(list_images(dataset.ref_dir), name, infer_camera(site) == "nadir") as walk:
        for query in progress(dataset.queries, len(dataset.queries), f"{site}, {name}"):
            event = walk.step(walks.make_frame(query.path))
            ranked = walks.list_ranked_names(event, dataset.references)
            best = next((rank for rank, place in enumerate(ranked) if place not in query.ignored), None)
            best_scores.append(0.0 if best is None else float(event.ranking.scores[best]))
            is_right.append(best is not None and ranked[best] in query.correct)
    return np.array(best_scores), np.array(is_right)


def measure_gates(
    name: str,
    technique: str,
    score: np.ndarray,
    is_right: np.ndarray,
    scores: list[dict[str, Salience]],
    kept: dict[str, np.ndarray],
) -> Iterable[Row]:
    """Yield the rows of a technique on a set: without a gate, with all criteria, and with each alone. The map has all
    references, as in the thesis. `auc` counts a discarded query as a true negative, as the thesis does; `recall_strict`
    counts it as a miss. Of the discarded queries, `true_discarded` were matched rightly without the gate and
    `false_discarded` wrongly. `places` is the share of the references that pass the gate, by the masks `kept`."""
    for gate in GATES:
        passes = find_passing(scores, gate)
        precision, recall = metrics.precision_recall(score[passes], is_right[passes])
        yield {
            "set": name,
            "technique": technique,
            "gate": gate,
            "recall": float(is_right[passes].mean()) if passes.any() else 0.0,
            "auc": float(metrics.auc_2_3(precision, recall)) if passes.any() else 0.0,
            "recall_strict": float((is_right & passes).mean()),
            "queries": len(passes),
            "true_discarded": int((is_right & ~passes).sum()),
            "false_discarded": int((~is_right & ~passes).sum()),
            "places": float(kept[gate].mean()),
        }


def compute_scores_by_gate(path: Path, memorability: Memorability, detector: Detector | None) -> dict[str, Salience]:
    """Return the scores of a picture by gate. Only the gates with the staticity criterion use the detector."""
    picture = read_image(path)
    without_detector = compute_scores(picture, memorability)
    if detector is None:
        return dict.fromkeys(GATES, without_detector)
    with_detector = compute_scores(picture, memorability, detector.is_static(picture))
    return {gate: with_detector if gate in ("all three", "staticity") else without_detector for gate in GATES}


def find_passing(scores: list[dict[str, Salience]], gate: str) -> np.ndarray:
    """Return which pictures pass a gate by their scores, bool (N,)."""
    return np.array([judge_scores(score[gate], GATES[gate]).reason is None for score in scores])


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


def format_page(result: Row) -> str:
    """Return the results as Markdown."""
    rows = result["gate"]
    unseen = [{"pictures": pictures, **by_site} for pictures, by_site in result["unseen"].items()]
    columns = {"pictures": "{pictures}", **{name: f"{{{name}:.2f}}" for name in list(unseen[0])[1:]}}
    discards = {(row["set"], row["technique"]) for row in rows if row["true_discarded"] or row["false_discarded"]}
    sets = list(dict.fromkeys(row["set"] for row in rows))
    unchanged = [name for name in sets if not any(set_name == name for set_name, _ in discards)]
    shares = {(row["gate"], row["set"]): row["places"] for row in rows}
    speed = [{"what": what, "ms": t_ms} for what, t_ms in result["speed"].items()]
    sizes = [{"gate": gate, **{name: shares[gate, name] for name in sets}} for gate in GATES if gate != "none"]
    return f"""# Memorable maps: what the gate and the choice of places gain

Made by `python benchmarks/bench_salience.py`, {result["date"]}, commit {result["commit"]}, {result["machine"]["cpu"]}.
Thresholds: memorability {FULL_GATE.memorability:g}, staticity {FULL_GATE.staticity:g}, entropy {FULL_GATE.entropy:g}.

## Time of a frame of 640x480, one thread

{base.format_table(speed, {"what": "{what}", "ms": "{ms:.1f}"})}

## Does memorability predict which frames are matched? ROC AUC on sites left out of the fit (chance: 0.50)

{base.format_table(unseen, columns)}

## With and without the gate

recall@1 and AUC count a discarded query as a true negative, as the thesis does; *strict* counts it as a miss. *right*
and *wrong*: discarded queries that would have been matched rightly and wrongly. The map has all references. The gate
discards no query of {", ".join(unchanged) or "any set"}: there all figures are those without a gate.

{base.format_table([row for row in rows if (row["set"], row["technique"]) in discards], _GATE)}

Size of a map that is built with the gate, before coverage gaps are filled: share of the references kept

{base.format_table(sizes, {"gate": "{gate}", **{name: f"{{{name}:.0%}}" for name in sets}})}

"""


if __name__ == "__main__":
    base.run(main)
