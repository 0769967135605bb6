"""How sure a match is, leave-one-site-out on every set: `python confidence.py`, part of `make results`.

The evidence of every query in the map of every set is gathered first (see `confidence_rows`; an hour on two cores,
kept in --work). Then, for each set, the shipped model is fitted anew to all other sites, adapted to the map of the set
as `map build` does, and judged by the set's own queries and by those of all other sites. Whatever is reported of a site
has been fitted without it. Which evidence counts, and how far a map moves the weights, was chosen with all sets in
view.

Writes confidence.json and confidence.md into benchmarks/results/; --ship writes the models that edgevpr has.
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
from edgevpr.runtime.recognise.calibration import MIN_PLACES
from edgevpr.runtime.recognise.confidence import Model
from edgevpr.runtime.recognise.evidence import AHEAD, AHEAD_PROVEN, DOWN, DOWN_BARE, Evidence
from edgevpr.runtime.recognise.judge import ConfidenceRule, make_accept_rule
from edgevpr.runtime.recognise.place_filter import PlaceFilter

PRECISIONS = (0.9, 0.99, 0.999)
EVIDENCE_KINDS = {"forward": (AHEAD, AHEAD_PROVEN), "nadir": (DOWN, DOWN_BARE)}
ROUTE_SETS = ("corridor", "grief_stromovka_seasons", "nordland_tiny")  # as the map was made
_MAX_QUERIES = 250  # queries
_BINS = 10
Rows = dict[str, list[Row]]
Models = dict[str, Model]  # by the kind of evidence
_COLUMNS = {
    "set": "{set}",
    "use": "{use}",
    "queries": "{queries}",
    "right": "{right}",
    "ROC AUC, score": "{roc_auc_score:.3f}",
    "ROC AUC, confidence": "{roc_auc:.3f}",
    "calibration error": "{ece:.3f}",
} | {
    f"accepted at {precision:g}: right, wrong, beside, foreign": "{at%d[share]:.2f}, {at%d[wrong]}, {at%d[beside]}, "
    "{at%d[foreign]} of {foreign}".replace("%d", str(number))
    for number, precision in enumerate(PRECISIONS)
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, default=Path("confidence_rows"), help="folder of the gathered evidence")
    parser.add_argument("--ship", type=Path, metavar="DIR", help="write the models of all sites there")
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
    """Write the models of all sites."""
    for camera, kinds in EVIDENCE_KINDS.items():
        names = [name for name in rows if infer_camera(name) == camera]
        count = sum(row.kind in ("own", "foreign") for name in names for row in rows[name])
        for kind in kinds:
            made_of = f"{count} matches in the maps of {len(names)} sets"
            model = fit_shipped_model(kind, [make_site(rows[name], kind) for name in names], made_of)
            (folder / f"confidence_{kind}.json").write_text(json.dumps(asdict(model)) + "\n")


def _read_rows(path: Path) -> list[Row]:
    """Read gathered rows. A best place that was not worth a look at its landmarks has none that agree."""
    rows = pickle.loads(path.read_bytes())
    if infer_camera(path.stem) == "nadir":
        for number, row in enumerate(rows):
            if row.evidence.landmarks is None:
                rows[number] = replace(row, evidence=replace(row.evidence, landmarks=0.0))
    return rows


def make_site(rows: Sequence[Row], kind: str, without: str | None = None) -> SiteEvidence:
    """Return what a map says of its site, without the queries of `without`. A place beside a right one is right."""
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
    """Return the models of the map of one set, from the other sites and from what the map says of itself."""
    camera, own_site = infer_camera(name), find_site(name)
    others = [other for other in rows if infer_camera(other) == camera and find_site(other) != own_site]
    is_adapted = len({row.query for row in rows[name] if row.kind == THERE}) >= MIN_PLACES
    models = {}
    for kind in EVIDENCE_KINDS[camera]:
        sites = [make_site(rows[other], kind, own_site) for other in others]
        model = fit_shipped_model(kind, sites, "other sites")
        models[kind] = adapt_model(model, kind, make_site(rows[name], kind).answers, name) if is_adapted else model
    return models


def judge_queries(rows: Sequence[Row], models: Models) -> base.Row:
    """Judge the queries of one map, its own and those of other sites."""
    own, foreign = ([row for row in rows if row.kind == kind] for kind in ("own", "foreign"))
    rule = ConfidenceRule(models, PRECISIONS[-1])
    confidence = np.array([max(map(rule.confidence, _list_evidence(row))) for row in own])
    right = np.array([row.right for row in own])
    bins = np.minimum((_BINS * confidence).astype(int), _BINS - 1)
    apart = np.bincount(bins, confidence - right) / len(own)  # of each bin, by its share of the queries
    result = {"set": rows[0].map, "use": base.find_use(rows[0].map), "queries": len(own), "right": int(right.sum())}
    result |= {"foreign": len(foreign), "roc_auc_score": roc_auc(np.array([row.score for row in own]), right)}
    result |= {"roc_auc": roc_auc(confidence, right), "ece": float(abs(apart).sum()), "precision": {}}
    for precision in PRECISIONS:
        accepted = [row for row in own if _is_accepted(models, row, precision)]
        result["precision"][str(precision)] = {
            "accepted_right": sum(row.right for row in accepted),
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
    """Return the evidence of a row before landmarks are compared, ahead, and all of it: both can make a match sure."""
    return replace(row.evidence, proof=0.0), row.evidence


def replay_routes(name: str, models: dict[str, Models]) -> base.Row:
    """Fly along the way of a map in several manners, each query by itself and followed, and count fixes."""
    dataset = walks.load_matched_set(DATA / name)
    truth = {query.path.name: query for query in dataset.queries}
    own = [path for path in list_images(DATA / name / "query") if path.name in truth][:_MAX_QUERIES]
    other = "grief_michigan_monthly" if name != "nordland_tiny" else "corridor"
    foreign = list_images(DATA / other / "query")[:30]
    middle, third = len(own) // 2, len(own) // 3
    manners = {
        "as mapped": own,
        "twice as fast": own[::2],
        "half as fast": [path for path in own for _ in range(2)],
        "back": own[::-1],
        "hover": own[:third] + [own[third]] * 20 + own[third:],
        "jump": own[:third] + own[2 * third :] + own[third : 2 * third],
        "leave": own[:middle] + foreign + own[middle:],
    }
    result: base.Row = {"set": name, "ways": {}}
    with walks.make_map(DATA / name) as (place_map, index, technique):
        rule = make_accept_rule(technique, walks.make_config().match)
        rule = replace(rule, confidence_rule=ConfidenceRule(models[name], walks.make_config().match.accept_precision))
        for manner, paths in manners.items():
            counts = {}
            for mode in ("alone", "followed"):
                place_filter = PlaceFilter(place_map, max_speed_m_s=None, is_live=False) if mode == "followed" else None
                walk = walks.make_walk(place_map, index, technique, rule=rule, place_filter=place_filter)
                counts[mode] = {"queries": 0, "right": 0, "beside": 0, "wrong": 0, "foreign": 0}
                for path in paths:
                    event, query = walk.step(walks.make_frame(path)), truth.get(path.name) if path in own else None
                    counts[mode]["queries"] += query is not None
                    if event.accepted:
                        kind = classify_match(event.best.place.source_image, query, dataset.references, index)
                        counts[mode][kind] += 1
            result["ways"][manner] = counts
    return result


def format_page(result: base.Row) -> str:
    """Return the page for people."""
    for row in result["sets"]:
        for number, precision in enumerate(PRECISIONS):
            counts = row["precision"][str(precision)]
            row[f"at{number}"] = {**counts, "share": counts["accepted_right"] / max(1, row["right"])}
    default, manners = str(PRECISIONS[-1]), list(result["flights"][0]["ways"])
    accepted = sum(row["precision"][default]["foreign"] for row in result["sets"])
    asked = sum(row["foreign"] for row in result["sets"])
    flights = [
        {"set": flight["set"], "mode": mode, **{key: _format_counts(flight["ways"][key][mode]) for key in manners}}
        for flight in result["flights"]
        for mode in ("alone", "followed")
    ]
    table = base.format_table([{**row, "precision": None} for row in result["sets"]], _COLUMNS)
    return f"""# How sure a match is

{base.strip_title(__doc__, "Writes confidence.json")}

Right: share of the queries whose best place is right that are accepted. Wrong: accepted, and elsewhere. Beside:
accepted, and at most two places beside a right one, which the set does not count as right. Foreign: accepted queries of
other sites.

{table}

At {default}, {accepted} of {asked} foreign queries are accepted, over all pairings
of sets and both cameras.

## Followed from query to query

Flights along the way of the map, at the default precision, each query by itself and followed; nothing is known of time
or speed. Of nordland_tiny the first {_MAX_QUERIES} queries fly. Share of the queries accepted as the right place; in
brackets wrong, beside, foreign.

{base.format_table(flights, {name: f"{{{name}}}" for name in ("set", "mode", *manners)})}

{base.format_origin(result, "python benchmarks/confidence.py")}
"""


def _format_counts(count: base.Row) -> str:
    share = count["right"] / max(1, count["queries"])
    return f"{share:.2f} ({count['wrong']}, {count['beside']}, {count['foreign']})"


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
