"""Gather the evidence of every query in the map of every set, from which `confidence.py` fits and judges models."""

import pickle
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import base
import numpy as np
import run_sets
import walks
from base import DATA

from edgevpr.core.reasons import ReasonCode
from edgevpr.frames.images import list_images
from edgevpr.frames.level import UNKNOWN_VIEW, LevelledImage
from edgevpr.lab.evaluate.dataset import ScoredQuery
from edgevpr.mapmaking.calibrate import count_queries, query_map
from edgevpr.mapmaking.look_alikes import MapSearch
from edgevpr.places.index import PlaceIndex
from edgevpr.places.ranking import outside_neighbourhood
from edgevpr.runtime.recognise.calibration import read_calibration_for
from edgevpr.runtime.recognise.evidence import Evidence
from edgevpr.runtime.recognise.judge import make_accept_rule

# Sets of the same ground are one site.
SITES = {"grief_stromovka_monthly": "stromovka", "grief_stromovka_seasons": "stromovka"}
FOREIGN_ONLY_SETS = {"train_ie_tower": (12, "images")}  # no ground truth: every twelfth picture is a foreign query
FOREIGN_QUERY_STEPS = {"nordland_tiny": 5}  # every fifth of its 994 queries is a foreign query


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The evidence of a query in a map. `kind`: "own", "foreign", or how `calibrate` made the query from a picture of
    the map. `near`: the best place is wrong, but next to a right one. `veto`: why it is refused at any confidence."""

    map: str
    set: str
    query: str
    kind: str
    right: bool
    near: bool
    score: float
    evidence: Evidence
    veto: ReasonCode | None = None


def find_site(name: str) -> str:
    return SITES.get(name, name)


def list_query_images(name: str, is_own: bool) -> list[Path]:
    """Return the pictures of a set to use as its own queries, or as foreign ones."""
    step, folder = FOREIGN_ONLY_SETS.get(name, (1, "query"))
    return list_images(DATA / name / folder)[:: step if is_own else step * FOREIGN_QUERY_STEPS.get(name, 1)]


def yield_rows(name: str, folder: Path) -> Iterator[Row]:
    """Match the queries of all sets in the map of the set `name`, which is in `folder`, and changed pictures of it."""
    dataset = walks.load_matched_set(folder)
    scored = {query.path.name: query for query in dataset.queries}
    with walks.make_map(folder, images=folder / "ref") as (place_map, index, technique):
        rule = make_accept_rule(technique, walks.make_config().match, 1, read_calibration_for(place_map))
        rule = replace(rule, confidence_rule=replace(rule.confidence_rule, precision=0.5))  # so that only vetoes refuse
        walk = walks.make_walk(place_map, index, technique, rule=rule, all_evidence=True)
        for query_set in [set_folder.name for set_folder in base.find_sets()] + list(FOREIGN_ONLY_SETS):
            if query_set != name and find_site(query_set) == find_site(name):
                continue
            for path in list_query_images(query_set, query_set == name):
                if query_set == name and path.name not in scored:
                    continue
                event = walk.step(walks.make_frame(path))
                if event.evidence is None:
                    continue
                image, query = event.best.place.source_image, scored.get(path.name) if query_set == name else None
                kind = classify_match(image, query, dataset.references, index)
                if kind == "ignored":
                    continue
                refused = not event.accepted and event.confidence >= rule.confidence_rule.threshold(event.evidence)
                yield Row(
                    map=name,
                    set=query_set,
                    query=path.name,
                    kind="own" if query_set == name else "foreign",
                    right=kind == "right",
                    near=kind == "beside",
                    score=event.best.match.score,
                    evidence=event.evidence,
                    veto=event.reason.code if refused else None,
                )
        if technique.spec.looks_down and np.isnan(index.lat_deg).any():
            return  # such a map is not calibrated
        frames = list(walks.read_folder_frames(folder / "ref"))
        order = np.random.default_rng(15).permutation(len(frames))
        frames = [frames[number] for number in np.resize(order, min(count_queries(technique), 6 * len(frames)))]
        ids = {place.source_image: place.place_id for place in place_map.read_places()}
        pictures = ((ids[frame.name], LevelledImage(frame.image, None, UNKNOWN_VIEW)) for frame in frames)
        for answer in query_map(MapSearch(place_map, technique, rule, walks.make_meter()), pictures):
            if answer.evidence is not None:
                fields = {"kind": answer.way, "right": answer.right, "evidence": answer.evidence}
                yield Row(map=name, set=name, query=str(answer.place_id), near=False, score=0.0, **fields)


def classify_match(image: str, query: ScoredQuery | None, references: Sequence[str], index: PlaceIndex) -> str:
    """Return how the best place, given by its image, fits a query (None: of another site): "right", "ignored",
    "beside" a right place, "wrong" or "foreign"."""
    if query is None:
        return "foreign"
    if image in query.correct:
        return "right"
    if image in query.ignored:
        return "ignored"
    right_slots = np.flatnonzero([name in query.correct or name in query.ignored for name in references])
    return "wrong" if outside_neighbourhood(index, references.index(image), right_slots, 0.0).all() else "beside"


def gather_rows(work: Path, name: str) -> None:
    """Write the evidence rows of the map of a set, unless their file exists."""
    path = work / f"{name}.pkl"
    if not path.exists():
        work.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as temporary:
            rows = list(yield_rows(name, run_sets.place_sites(DATA / name, Path(temporary))))
        path.with_suffix(".new").write_bytes(pickle.dumps(rows))
        path.with_suffix(".new").replace(path)
        print(name, len(rows), flush=True)
