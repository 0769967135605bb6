"""How sure a match is, leave-one-site-out on every set: `python confidence.py`, part of `make results`.

The evidence of every query in the map of every set is gathered first (see `confidence_rows`; an hour on two cores,
kept in --work). Then, for each set, the shipped model is fitted anew to all other sites, adapted to the map of the set
as `map build` does, and judged by the set's own queries and by those of all other sites. Whatever is reported of a site
has been fitted without it. Which evidence counts, and how far a map moves the weights, was chosen with all sets in
view.

Writes confidence.json, confidence.md and confidence.png (reliability) into benchmarks/results/; --gallery draws every
match that was wrongly accepted, to look at.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import argparse
import json
import pickle
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from confidence_rows import CONFIG, Row, frames_of, gather, kind_of_match, site_of, walk_over
from hostile_pictures import camera_of
from run_sets import DATA, RESULTS, TUNED_ON, made_by

from edgevpr.core.text import markdown
from edgevpr.core.types import Frame
from edgevpr.frames.images import list_images, read_image
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import mapped
from edgevpr.lab.evaluate.metrics import roc_auc
from edgevpr.mapmaking.calibrate import LEFT_OUT, MIRRORED, THERE, Answer, adapted
from edgevpr.mapmaking.prior import Site, shipped_model
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.confidence import Model, as_json
from edgevpr.runtime.recognise.evidence import AHEAD, DOWN, DOWN_BARE, kind_of
from edgevpr.runtime.recognise.follow import Follower
from edgevpr.runtime.recognise.judge import Sureness, accept_rule
from edgevpr.runtime.recognise.opening import meter_of
from edgevpr.runtime.recognise.stored_confidence import FEWEST_PLACES
from edgevpr.techniques import create

PRECISIONS = (0.9, 0.99, 0.999)
KINDS = {"forward": (AHEAD,), "nadir": (DOWN, DOWN_BARE)}
FLOWN_ALONG = ("corridor", "grief_stromovka_seasons", "nordland_tiny")  # as the map was made
_MOST_FLOWN = 250  # queries
_BINS = 10
Rows = dict[str, list[Row]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, default=Path("confidence_rows"), help="folder of the gathered evidence")
    parser.add_argument("--ship", type=Path, metavar="DIR", help="write the models of all sites there")
    parser.add_argument("--gallery", type=Path, metavar="PNG", help="draw what was wrongly accepted")
    args = parser.parse_args()
    names = [path.parent.name for path in sorted(DATA.glob("*/ground_truth.csv"))]
    with ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(partial(gather, args.work), [[name] for name in names]))
        rows = {name: _read(args.work / f"{name}.pkl") for name in names}
        models = {name: model_without(name, rows) for name in names}
        flights = list(pool.map(partial(followed, models=models), FLOWN_ALONG))
    if args.ship:
        for camera, kinds in KINDS.items():
            of = [name for name in names if camera_of(name) == camera]
            count = sum(row.kind in ("own", "foreign") for name in of for row in rows[name])
            for kind in kinds:
                made_of = f"{count} matches in the maps of {len(of)} sets"
                model = shipped_model(kind, [site(rows[name], kind) for name in of], made_of)
                (args.ship / f"confidence_{kind}.json").write_text(as_json(model) + "\n")
    sets = [judged(rows[name], models[name]) for name in names]
    found = {**made_by(), "sets": sets, "flights": flights, "reliability": reliability(rows, models)}
    (RESULTS / "confidence.json").write_text(json.dumps(found, indent=1) + "\n")
    (RESULTS / "confidence.md").write_text(_page(found))
    _draw_reliability(found["reliability"], RESULTS / "confidence.png")
    if args.gallery:
        _draw_gallery(rows, models, args.gallery)


def _read(path: Path) -> list[Row]:
    """Read gathered rows. A best place that was not worth a look at its landmarks has none that agree."""
    rows = pickle.loads(path.read_bytes())
    if camera_of(path.stem) == "nadir":
        for row in rows:
            row.evidence.setdefault("landmarks", 0.0)
    return rows


def site(rows: Sequence[Row], kind: str, without: str | None = None) -> Site:
    """Return what a map says of its site, without the queries of `without`. A place beside a right one is right."""
    return Site(
        name=rows[0].map,
        own=[(row.evidence, row.right or row.near) for row in rows if row.kind == "own"],
        foreign=[row.evidence for row in rows if row.kind == "foreign" and site_of(row.set) != without],
        answers=[
            Answer(place_id=0, way=row.kind, right=row.right, evidence=row.evidence)
            for row in rows
            if row.kind in (THERE, LEFT_OUT, MIRRORED)
        ],
    )


def model_without(name: str, rows: Rows) -> Model:
    """Return the model of the map of one set, from the other sites and from what the map says of itself."""
    kind = KINDS[camera_of(name)][0]
    others = [of for of in rows if camera_of(of) == camera_of(name) and site_of(of) != site_of(name)]
    model = shipped_model(kind, [site(rows[of], kind, site_of(name)) for of in others], "other sites")
    if len({row.query for row in rows[name] if row.kind == THERE}) < FEWEST_PLACES:
        return model
    return adapted(model, site(rows[name], kind).answers, name)


def judged(rows: Sequence[Row], model: Model) -> dict:
    """Judge the queries of one map, its own and those of other sites."""
    own = [row for row in rows if row.kind == "own"]
    foreign = [row for row in rows if row.kind == "foreign"]
    sure, right = np.array([_sure(model, row) for row in own]), np.array([row.right for row in own])
    made = {
        "set": rows[0].map,
        "use": "tune" if rows[0].map in TUNED_ON else "report",
        "queries": len(own),
        "right": int(right.sum()),
        "foreign": len(foreign),
        "roc_auc_score": roc_auc(np.array([row.score for row in own]), right),
        "roc_auc": roc_auc(sure, right),
        "ece": calibration_error(sure, right),
        "precision": {},
    }
    for precision in PRECISIONS:
        taken = [row for row in own if _accepted(model, row, precision)]
        made["precision"][str(precision)] = {
            "accepted_right": sum(row.right for row in taken),
            "wrong": sum(not row.right and not row.near for row in taken),
            "beside": sum(row.near for row in taken),
            "foreign": sum(_accepted(model, row, precision) for row in foreign),
        }
    return made


def _sure(model: Model, row: Row) -> float:
    return Sureness({kind_of(row.evidence): model}, PRECISIONS[-1]).confidence(row.evidence)


def _accepted(model: Model, row: Row, precision: float) -> bool:
    return row.veto is None and _sure(model, row) >= model.threshold(precision)


def calibration_error(sure: np.ndarray, right: np.ndarray) -> float:
    """Return the expected calibration error: how far confidence and share of right ones are apart, in ten bins."""
    bins = np.minimum((_BINS * sure).astype(int), _BINS - 1)
    apart = [abs(sure[bins == each].mean() - right[bins == each].mean()) * np.mean(bins == each) for each in set(bins)]
    return float(sum(apart))


def reliability(rows: Rows, models: dict[str, Model]) -> dict:
    """Return confidence and share of right ones of own queries, by camera, in ten bins; each set counts the same."""
    found = {}
    for camera in KINDS:
        names = [name for name in rows if camera_of(name) == camera]
        own = [(name, row) for name in names for row in rows[name] if row.kind == "own"]
        sure = np.array([_sure(models[name], row) for name, row in own])
        right = np.array([row.right for _, row in own])
        weight = np.array([1 / sum(row.kind == "own" for row in rows[name]) for name, _ in own])
        bins = np.minimum((_BINS * sure).astype(int), _BINS - 1)
        found[camera] = [
            {
                "confidence": float(np.average(sure[bins == each], weights=weight[bins == each])),
                "right": float(np.average(right[bins == each], weights=weight[bins == each])),
                "queries": int(np.count_nonzero(bins == each)),
            }
            for each in sorted(set(bins.tolist()))
        ]
    return found


def followed(name: str, models: dict[str, Model]) -> dict:
    """Fly along the way of a map in several manners, each query by itself and followed, and count fixes."""
    folder = DATA / name
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    truth = {query.path.name: query for query in dataset.queries}
    own = [path for path in list_images(folder / "query") if path.name in truth][:_MOST_FLOWN]
    other = "grief_michigan_monthly" if name != "nordland_tiny" else "corridor"
    foreign = list_images(DATA / other / "query")[:30]
    middle, third = len(own) // 2, len(own) // 3
    ways = {
        "as mapped": own,
        "twice as fast": own[::2],
        "half as fast": [path for path in own for _ in range(2)],
        "back": own[::-1],
        "hover": own[:third] + [own[third]] * 20 + own[third:],
        "jump": own[:third] + own[2 * third :] + own[third : 2 * third],
        "leave": own[:middle] + foreign + own[middle:],
    }
    technique = create("cohog", {"camera": camera_of(name)})
    meter = meter_of(CONFIG, load_board("this"))
    rule = accept_rule(technique, CONFIG.match)
    rule = replace(rule, sure=Sureness({AHEAD: models[name]}, CONFIG.match.accept_precision))
    made: dict = {"set": name, "ways": {}}
    with mapped(frames_of(folder / "ref"), technique, meter) as (place_map, index):
        for way, paths in ways.items():
            counts = {}
            for follows in (False, True):
                follower = Follower(place_map, fastest_m_s=None, is_live=False) if follows else None
                walk = walk_over(place_map, index, technique, rule, follower)
                count = {"queries": 0, "right": 0, "beside": 0, "wrong": 0, "foreign": 0}
                for path in paths:
                    event = walk.step(Frame(image=read_image(path), name=path.name, t_mono_s=0.0))
                    query = truth.get(path.name) if path in own else None
                    count["queries"] += query is not None
                    if event.accepted:
                        count[kind_of_match(event.best.place.source_image, query, dataset.references, index)] += 1
                counts["followed" if follows else "alone"] = count
            made["ways"][way] = counts
    return made


def _page(found: dict) -> str:
    text = __doc__.partition("\n\n")[2].partition("Writes confidence.json")[0].strip()
    header = ["set", "use", "queries", "right", "ROC AUC, score", "ROC AUC, confidence", "calibration error"]
    header += [f"accepted at {precision:g}: right, wrong, beside, foreign" for precision in PRECISIONS]
    cells = []
    for row in found["sets"]:
        auc = ["-" if row[key] is None else f"{row[key]:.3f}" for key in ("roc_auc_score", "roc_auc")]
        line = [row["set"], row["use"], str(row["queries"]), str(row["right"]), *auc, f"{row['ece']:.3f}"]
        for precision in PRECISIONS:
            of = row["precision"][str(precision)]
            share = of["accepted_right"] / max(1, row["right"])
            line.append(f"{share:.2f}, {of['wrong']}, {of['beside']}, {of['foreign']} of {row['foreign']}")
        cells.append(line)
    foreign = sum(row["foreign"] for row in found["sets"])
    default = str(PRECISIONS[-1])
    taken = sum(row["precision"][default]["foreign"] for row in found["sets"])
    ways = list(found["flights"][0]["ways"])
    flown = [
        [flight["set"], mode, *(_flown(flight["ways"][way][mode]) for way in ways)]
        for flight in found["flights"]
        for mode in ("alone", "followed")
    ]
    return (
        f"# How sure a match is\n\n{text}\n\nRight: share of the queries whose best place is right that are accepted. "
        "Wrong: accepted, and elsewhere. Beside: accepted, and at most two places beside a right one, which the set "
        "does not count as right. Foreign: accepted queries of other sites.\n\n"
        f"{markdown(header, cells)}\n\nAt {default}, {taken} of {foreign} foreign queries are accepted, over all "
        "pairings of sets and both cameras.\n\n![reliability](confidence.png)\n\n## Followed from query to query\n\n"
        "Flights along the way of the map, at the default precision, each query by itself and followed; nothing is "
        f"known of time or speed. Of nordland_tiny the first {_MOST_FLOWN} queries fly. Share of the queries "
        "accepted as the right place; in brackets wrong, beside, foreign.\n\n"
        f"{markdown(['set', 'mode', *ways], flown)}\n\nCommit {found['commit']}, {found['date']}, "
        f"{found['machine']['cpu']}. Made by `python benchmarks/confidence.py`.\n"
    )


def _flown(count: dict) -> str:
    share = count["right"] / max(1, count["queries"])
    return f"{share:.2f} ({count['wrong']}, {count['beside']}, {count['foreign']})"


def _draw_reliability(found: dict, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(found), figsize=(9, 4.4), sharey=True)
    for axis, (camera, bins) in zip(axes, found.items(), strict=True):
        axis.plot([0, 1], [0, 1], color="0.7", linewidth=1)
        sizes = [20 + 60 * np.log10(each["queries"]) for each in bins]
        axis.scatter([each["confidence"] for each in bins], [each["right"] for each in bins], s=sizes, color="#2060c0")
        for each in bins:
            axis.annotate(each["queries"], (each["confidence"], each["right"]), (8, -12), textcoords="offset points")
        axis.set(xlabel="confidence", title={"forward": "ahead", "nadir": "straight down"}[camera], xlim=(-0.03, 1.06))
    axes[0].set(ylabel="share of right matches", ylim=(-0.03, 1.06))
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def _draw_gallery(rows: Rows, models: dict[str, Model], path: Path) -> None:
    """Draw query and place side by side of all that was wrongly accepted at the lower precisions too."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    is_wrong: Callable[[Row], bool] = lambda row: not row.right and row.kind in ("own", "foreign")  # noqa: E731
    wrong = [
        (precision, row)
        for name in rows
        for row in rows[name]
        if is_wrong(row)
        for precision in PRECISIONS[:0:-1]
        if _accepted(models[name], row, precision)
    ]
    worst = {id(row): (precision, row) for precision, row in reversed(wrong)}
    shown = sorted(worst.values(), key=lambda each: (-each[0], each[1].map))[:30]
    figure, axes = pyplot.subplots(max(1, len(shown)), 2, figsize=(9, 3 * max(1, len(shown))), squeeze=False)
    for (left, right), (precision, row) in zip(axes, shown, strict=False):
        folder = DATA / row.set / ("query" if (DATA / row.set / "query").is_dir() else "images")
        left.imshow(read_image(folder / row.query), cmap="gray")
        right.imshow(read_image(DATA / row.map / "ref" / row.found), cmap="gray")
        kind = "beside" if row.near else row.kind
        left.set_title(f"{row.set}/{row.query}, {kind}, at {precision:g}", fontsize=8)
        right.set_title(f"{row.map}/{row.found}: {_sure(models[row.map], row):.4f}", fontsize=8)
    for axis in axes.ravel():
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    main()
