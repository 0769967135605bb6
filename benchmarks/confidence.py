"""Judge the confidence of matches, leaving one site out, on every set: `python benchmarks/confidence.py`.

The script first gathers the evidence of every query in the map of every set (see `confidence_rows`; two hours on two
cores, kept in --work). For each set, it then fits the shipped model anew to all other sites, without any query of the
set's site, adapts it to the map of the set as `map build` does, and judges it by the queries of the set and of all
other sites. The kinds of evidence, and how far a map may change the weights, were chosen on all sets.

Writes confidence.json and confidence.md into benchmarks/results/; --ship writes the models that edgevpr ships.
"""

import argparse
import json
import os
import pickle
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import base
import numpy as np
import walks
from base import DATA, infer_camera
from confidence_rows import Row, classify_match, find_site, gather_rows
from shipped_model import SiteEvidence, fit_shipped_model

from edgevpr.frames.images import list_images
from edgevpr.lab.evaluate.metrics import roc_auc
from edgevpr.mapmaking.calibrate import LEFT_OUT, MIRRORED, THERE, QueryResult, adapt_model
from edgevpr.runtime.recognise.calibration import MIN_PLACES, read_calibration_for
from edgevpr.runtime.recognise.confidence import Model
from edgevpr.runtime.recognise.evidence import AHEAD, AHEAD_PROVEN, DOWN, DOWN_BARE, Evidence
from edgevpr.runtime.recognise.judge import ConfidenceRule, make_accept_rule
from edgevpr.runtime.recognise.place_filter import PlaceFilter

PRECISIONS = (0.9, 0.99, 0.999)
EVIDENCE_KINDS = {"forward": (AHEAD, AHEAD_PROVEN), "nadir": (DOWN, DOWN_BARE)}
ROUTE_SETS = ("corridor", "grief_stromovka_seasons", "nordland_tiny")  # whose queries follow the route of the map
_MAX_QUERIES = 250  # of a replayed set
_BINS = 10
Rows = dict[str, list[Row]]
Models = dict[str, Model]  # by kind of evidence
_COLUMNS = {
    "set": "{set}",
    "use": "{use}",
    "queries": "{queries}",
    "right": "{right}",
    "ROC AUC, score": "{roc_auc_score:.3f}",
    "ROC AUC, confidence": "{roc_auc:.3f}",
    "calibration error": "{ece:.3f}",
} | {
    f"accepted at {precision:g}: right, wrong, beside, foreign": "{accepted[%s][share]:.2f}, {accepted[%s][wrong]}, "
    "{accepted[%s][beside]}, {accepted[%s][foreign]} of {foreign}".replace("%s", str(precision))
    for precision in PRECISIONS
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, default=Path("confidence_rows"), help="folder for the gathered evidence")
    parser.add_argument("--ship", type=Path, metavar="DIR", help="write models fitted to all sites into this folder")
    args = parser.parse_args()
    names = [folder.name for folder in base.find_sets()]
    with ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(partial(gather_rows, args.work), names))
        rows = {name: _read_rows(args.work / f"{name}.pkl") for name in names}
        models = {name: fit_held_out_models(name, rows) for name in names}
        flights = list(pool.map(partial(replay_routes, models=models), ROUTE_SETS))
    if args.ship:
        write_models(args.ship, rows)
    sets = [judge_queries(rows[name], models[name]) for name in names]
    result = {**base.describe_run(), "sets": sets, "flights": flights}
    base.write("confidence", result, format_page(result))


def write_models(folder: Path, rows: Rows) -> None:
    """Write one model for each kind of evidence, fitted to all sites."""
    for camera, kinds in EVIDENCE_KINDS.items():
        names = [name for name in rows if infer_camera(name) == camera]
        count = sum(row.kind in ("own", "foreign") for name in names for row in rows[name])
        for kind in kinds:
            origin = f"{count} matches in the maps of {len(names)} sets"
            model = fit_shipped_model(kind, [make_site(rows[name]) for name in names], origin)
            (folder / f"confidence_{kind}.json").write_text(json.dumps(asdict(model)) + "\n")


def _read_rows(path: Path) -> list[Row]:
    """Read gathered rows. In nadir rows, landmarks that were not compared count as none that agree."""
    rows = pickle.loads(path.read_bytes())
    if infer_camera(path.stem) == "nadir":
        for number, row in enumerate(rows):
            if row.evidence.landmarks is None:
                rows[number] = replace(row, evidence=replace(row.evidence, landmarks=0.0))
    return rows


def make_site(rows: Sequence[Row], without: str | None = None) -> SiteEvidence:
    """Return the evidence of one map, without the foreign queries of the site `without`. Neighbours of a right place
    count as right."""
    return SiteEvidence(
        name=rows[0].map,
        own=[(row.evidence, row.right or row.near) for row in rows if row.kind == "own"],
        foreign=[row.evidence for row in rows if row.kind == "foreign" and find_site(row.set) != without],
        answers=[
            QueryResult(place_id=0, way=row.kind, right=row.right, evidence=row.evidence)
            for row in rows
            if row.kind in (THERE, LEFT_OUT, MIRRORED)
        ],
    )


def fit_held_out_models(name: str, rows: Rows) -> Models:
    """Fit the models of the map of one set to all other sites, and adapt them to the map."""
    camera, own_site = infer_camera(name), find_site(name)
    others = [other for other in rows if infer_camera(other) == camera and find_site(other) != own_site]
    is_adapted = len({row.query for row in rows[name] if row.kind == THERE}) >= MIN_PLACES
    models = {}
    sites = [make_site(rows[other], own_site) for other in others]
    for kind in EVIDENCE_KINDS[camera]:
        model = fit_shipped_model(kind, sites, "other sites")
        models[kind] = adapt_model(model, kind, make_site(rows[name]).answers, name) if is_adapted else model
    return models


def judge_queries(rows: Sequence[Row], models: Models) -> base.Row:
    """Return the figures of one map, for its own queries and for those of other sites."""
    own, foreign = ([row for row in rows if row.kind == kind] for kind in ("own", "foreign"))
    rule = ConfidenceRule(models, PRECISIONS[-1])
    confidence = np.array([max(map(rule.confidence, _list_evidence(row))) for row in own])
    right = np.array([row.right for row in own])
    bins = np.minimum((_BINS * confidence).astype(int), _BINS - 1)
    gaps = np.bincount(bins, confidence - right) / len(own)  # of each bin, weighted by its share of the queries
    result = {"set": rows[0].map, "use": base.find_use(rows[0].map), "queries": len(own), "right": int(right.sum())}
    result |= {"foreign": len(foreign), "roc_auc_score": roc_auc(np.array([row.score for row in own]), right)}
    result |= {"roc_auc": roc_auc(confidence, right), "ece": float(abs(gaps).sum()), "accepted": {}}
    for precision in PRECISIONS:
        accepted = [row for row in own if _is_accepted(models, row, precision)]
        result["accepted"][str(precision)] = {
            "share": sum(row.right for row in accepted) / max(1, result["right"]),
            "wrong": sum(not row.right and not row.near for row in accepted),
            "beside": sum(row.near for row in accepted),
            "foreign": sum(_is_accepted(models, row, precision) for row in foreign),
        }
    return result


def _is_accepted(models: Models, row: Row, precision: float) -> bool:
    rule = ConfidenceRule(models, precision)
    pairs = ((rule.confidence(evidence), models[evidence.kind]) for evidence in _list_evidence(row))
    return row.veto is None and any(confidence >= model.threshold(precision) for confidence, model in pairs)


def _list_evidence(row: Row) -> tuple[Evidence, Evidence]:
    """Return the evidence of a row without and with proof by landmarks: either can be enough to accept a match."""
    return replace(row.evidence, proof=0.0), row.evidence


def replay_routes(name: str, models: dict[str, Models]) -> base.Row:
    """Replay the queries of a set in several orders, alone and with the place filter, and count accepted matches."""
    dataset = walks.load_matched_set(DATA / name)
    truth = {query.path.name: query for query in dataset.queries}
    own_paths = [path for path in list_images(DATA / name / "query") if path.name in truth][:_MAX_QUERIES]
    other_set = "grief_michigan_monthly" if name != "nordland_tiny" else "corridor"
    foreign_paths = list_images(DATA / other_set / "query")[:30]
    middle, third = len(own_paths) // 2, len(own_paths) // 3
    orders = {
        "as mapped": own_paths,
        "twice as fast": own_paths[::2],
        "half as fast": [path for path in own_paths for _ in range(2)],
        "back": own_paths[::-1],
        "hover": own_paths[:third] + [own_paths[third]] * 20 + own_paths[third:],
        "jump": own_paths[:third] + own_paths[2 * third :] + own_paths[third : 2 * third],
        "leave": own_paths[:middle] + foreign_paths + own_paths[middle:],
    }
    result: base.Row = {"set": name, "ways": {}}
    with walks.make_map(DATA / name, images=DATA / name / "ref") as (place_map, index, technique):
        rule = make_accept_rule(technique, walks.make_config().match, 1, read_calibration_for(place_map))
        rule = replace(rule, confidence_rule=ConfidenceRule(models[name], walks.make_config().match.accept_precision))
        for order, paths in orders.items():
            counts = {}
            for mode in ("alone", "followed"):
                place_filter = PlaceFilter(place_map, max_speed_m_s=None, is_live=False) if mode == "followed" else None
                walk = walks.make_walk(place_map, index, technique, rule=rule, place_filter=place_filter)
                counts[mode] = {"queries": 0, "right": 0, "beside": 0, "wrong": 0, "foreign": 0}
                for path in paths:
                    event = walk.step(walks.make_frame(path))
                    query = truth.get(path.name) if path in own_paths else None
                    counts[mode]["queries"] += query is not None
                    if event.accepted:
                        kind = classify_match(event.best.place.source_image, query, dataset.references, index)
                        counts[mode][kind] += 1
            result["ways"][order] = counts
    return result


def format_page(result: base.Row) -> str:
    """Return the results as Markdown."""
    orders = list(result["flights"][0]["ways"])
    accepted = sum(row["accepted"][str(PRECISIONS[-1])]["foreign"] for row in result["sets"])
    foreign = sum(row["foreign"] for row in result["sets"])
    flights = [
        {"set": flight["set"], "mode": mode, **{key: _format_counts(flight["ways"][key][mode]) for key in orders}}
        for flight in result["flights"]
        for mode in ("alone", "followed")
    ]
    return f"""# Confidence of matches

{base.strip_title(__doc__, "Writes confidence.json")}

Right: accepted share of the queries whose best place is right. Wrong: accepted queries whose best place is elsewhere.
Beside: accepted queries whose best place is at most two places from a right one, which the set does not count as right.
Foreign: accepted queries of other sites.

{base.format_table(result["sets"], _COLUMNS)}

At {PRECISIONS[-1]}, {accepted} of {foreign} foreign queries are accepted, over all pairs of sets
and both cameras.

## With the place filter

Flights along the route of the map at the default precision, with each query matched alone, and with the place filter
(*followed*), which knows neither time nor speed. Of nordland_tiny, only the first {_MAX_QUERIES} queries are used. The
share of the queries accepted at the right place; in brackets: wrong, beside, foreign.

{base.format_table(flights, {name: f"{{{name}}}" for name in ("set", "mode", *orders)})}

{base.format_origin(result, "python benchmarks/confidence.py")}
"""


def _format_counts(count: base.Row) -> str:
    share = count["right"] / max(1, count["queries"])
    return f"{share:.2f} ({count['wrong']}, {count['beside']}, {count['foreign']})"


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
