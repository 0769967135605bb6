"""Evidence of every query of every set in the map of every set: what `confidence.py` fits and judges.

python benchmarks/confidence_rows.py WORK [SET ...] writes WORK/SET.pkl for each map, unless it is there already.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import pickle
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from hostile_pictures import camera_of
from run_sets import DATA

from edgevpr.core.config import load_config
from edgevpr.core.contract import Technique
from edgevpr.core.types import Frame
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.level import UNKNOWN_VIEW, Levelled
from edgevpr.frames.source import open_source
from edgevpr.lab.evaluate.dataset import ScoredQuery, load_dataset
from edgevpr.lab.evaluate.evaluate import all_frames, mapped
from edgevpr.mapmaking.calibrate import ask, asked_of
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import elsewhere
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.follow import Follower
from edgevpr.runtime.recognise.judge import AcceptRule, accept_rule
from edgevpr.runtime.recognise.opening import meter_of
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques import create

CONFIG = load_config(None)
# Sets of the same ground are one site.
SITES = {"grief_stromovka_monthly": "stromovka", "grief_stromovka_seasons": "stromovka"}
LIKE = {"train_ie_tower": (12, "images")}  # no truth: every twelfth picture, as a foreign query only
THINNED = {"nordland_tiny": 5}  # of 994 foreign queries every fifth


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A query in a map. `kind` is own, foreign, or the way in which a changed picture of the map itself was asked for
    (see `calibrate`). `near`: wrong, and the neighbour of a right place. `veto`: why no confidence would be enough."""

    map: str
    set: str
    query: str
    kind: str
    right: bool
    near: bool
    found: str
    score: float
    evidence: dict[str, float]
    veto: str | None = None


def site_of(name: str) -> str:
    return SITES.get(name, name)


def queries_of(name: str, is_own: bool) -> list[Path]:
    step, folder = LIKE.get(name, (1, "query"))
    return list_images(DATA / name / folder)[:: step if is_own else step * THINNED.get(name, 1)]


def rows_of(name: str) -> Iterator[Row]:
    """Ask the map of one set everything."""
    folder, technique = DATA / name, create("cohog", {"camera": camera_of(name)})
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    scored = {query.path.name: query for query in dataset.queries}
    rule = accept_rule(technique, CONFIG.match)
    rule = replace(rule, sure=replace(rule.sure, precision=0.5))  # only what speaks against the best places refuses
    meter = meter_of(CONFIG, load_board("this"))
    with mapped(frames_of(folder / "ref"), technique, meter, folder / "ref") as (place_map, index):
        walk = walk_over(place_map, index, technique, rule)
        names = dataset.references
        for other in [path.parent.name for path in sorted(DATA.glob("*/ground_truth.csv"))] + list(LIKE):
            if other != name and site_of(other) == site_of(name):
                continue
            for path in queries_of(other, other == name):
                if other == name and path.name not in scored:
                    continue
                event = walk.step(Frame(image=read_image(path), name=path.name, t_mono_s=0.0))
                if event.evidence is None:
                    continue
                found = event.best.place.source_image
                kind = kind_of_match(found, scored.get(path.name) if other == name else None, names, index)
                if kind == "ignored":
                    continue
                refused = not event.accepted and event.confidence >= rule.sure.threshold(event.evidence)
                yield Row(
                    map=name,
                    set=other,
                    query=path.name,
                    kind="own" if other == name else "foreign",
                    right=kind == "right",
                    near=kind == "beside",
                    found=found,
                    score=event.best.match.score,
                    evidence=dict(event.evidence),
                    veto=event.reason if refused else None,
                )
        if technique.spec.cells and np.isnan(index.lat_deg).any():
            return  # such a map is not calibrated
        frames = [(frame.name, Levelled(frame.image, None, UNKNOWN_VIEW)) for frame in frames_of(folder / "ref")]
        order = np.random.default_rng(15).permutation(len(frames))
        frames = [frames[at] for at in np.resize(order, min(asked_of(technique), 6 * len(frames)))]
        ids = {place.source_image: place.place_id for place in place_map.places()}
        pictures = ((ids[name], picture) for name, picture in frames)
        for answer in ask(technique, place_map, index, rule, meter, pictures):
            if answer.evidence is None:
                continue
            yield Row(
                map=name,
                set=name,
                query=str(answer.place_id),
                kind=answer.way,
                right=answer.right,
                near=False,
                found="",
                score=0.0,
                evidence=dict(answer.evidence),
            )


def frames_of(folder: Path) -> Iterator[Frame]:
    return all_frames(open_source(str(folder), live=False))


def walk_over(
    place_map: PlaceMap, index: PlaceIndex, technique: Technique, rule: AcceptRule, follower: Follower | None = None
) -> Recogniser:
    """Return a walk over a map with the technique's own number of candidates."""
    return Recogniser(
        technique=technique,
        place_map=place_map,
        index=index,
        rule=rule,
        meter=meter_of(CONFIG, load_board("this")),
        candidates=technique.candidates,
        follower=follower,
    )


def kind_of_match(found: str, query: ScoredQuery | None, references: Sequence[str], index: PlaceIndex) -> str:
    """Return what a best place is to a query (None: one of another site): right, ignored, beside a right one, wrong, or
    foreign."""
    if query is None:
        return "foreign"
    if found in query.right:
        return "right"
    if found in query.ignored:
        return "ignored"
    known = np.flatnonzero([each in query.right or each in query.ignored for each in references])
    return "wrong" if elsewhere(index, references.index(found), known, 0.0).all() else "beside"


def gather(work: Path, names: list[str]) -> None:
    work.mkdir(parents=True, exist_ok=True)
    for name in names:
        path = work / f"{name}.pkl"
        if not path.exists():
            rows = list(rows_of(name))
            path.with_suffix(".new").write_bytes(pickle.dumps(rows))
            path.with_suffix(".new").replace(path)
            print(name, len(rows), flush=True)


if __name__ == "__main__":
    gather(Path(sys.argv[1]), sys.argv[2:] or [path.parent.name for path in sorted(DATA.glob("*/ground_truth.csv"))])
