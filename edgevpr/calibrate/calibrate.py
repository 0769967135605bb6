"""Calibration of a map: it is asked for changed pictures of its own places, and how sure it can be is fitted to the
answers.

Each picture is asked for three times. As it is, it is of a place that the map has. Then that place and all that may
show the same ground are left out: the best match is one of the look-alikes that every map has. At last the picture is
mirrored: it shows ground that is nowhere, as the same camera would see it in the same country. What the shipped model
knows from many sites stays, as far as the answers do not say otherwise.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from typing import TypeVar

import numpy as np

from edgevpr.calibrate.changes import changed
from edgevpr.calibrate.fit import fitted
from edgevpr.confidence.model import Evidence, Logistic, Model, prior
from edgevpr.confidence.stored import Calibration, as_text
from edgevpr.config import MatchConfig
from edgevpr.contract import Technique
from edgevpr.geodesy import distance_m
from edgevpr.places.index import PlaceIndex, bytes_per_place, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import elsewhere
from edgevpr.places.sequence import Alone
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.evidence import kind_of, kinds_of
from edgevpr.runtime.recognise.judge import AcceptRule, accept_rule
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.types import Frame

T = TypeVar("T")
Watch = Callable[[Iterable[T], int], Iterable[T]]

THERE, LEFT_OUT, MIRRORED = "there", "left out", "mirrored"
FEWEST_PLACES = 30  # with fewer the shipped model is used as it is
ASKED = 120  # pictures
_BESIDE_PLACES = 10  # before and after a place without position: they may show the same ground
_LEFT_OUT_COUNTS = 0.3  # over ground that is not in the map nobody flies as often
# How far a map moves the shipped weights; chosen on corridor, with grief_stromovka_seasons and nordland_tiny in view.
_PULL_OF_MAP, _PULL_OF_PLACE = 20.0, 5.0
_SEED = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """The answer to one question of a map: of which place the picture was, in which `way` it was asked for (THERE,
    LEFT_OUT, MIRRORED), whether the best place was `right`, and its evidence."""

    place_id: int
    way: str
    right: bool
    evidence: Evidence


def ask(
    technique: Technique,
    place_map: PlaceMap,
    index: PlaceIndex,
    rule: AcceptRule,
    meter: QueryMeter,
    frames: Iterable[Frame],
    ids: dict[str, int],
    seed: int = 0,
) -> Iterable[Answer]:
    """Ask a map for changed pictures of its own places, with the place and without it. `frames` are pictures that the
    map was made of, and `ids` the places by the names of their pictures."""
    rng = np.random.default_rng((_SEED, seed))
    walk = Recogniser(
        technique=technique,
        place_map=place_map,
        index=index,
        rule=rule,
        meter=meter,
        candidates=technique.candidates,
    )
    looks_down = technique.spec.cells is not None
    for frame in frames:
        place_id = ids[frame.name]
        slot = int(np.flatnonzero(index.place_ids == place_id)[0])
        others = _without(index, _same_ground(place_map, index, slot, rule.neighbour_m))
        mirrored = np.ascontiguousarray(frame.image[:, ::-1])
        for way, image, among in (
            (THERE, frame.image, index),
            (LEFT_OUT, frame.image, others),
            (MIRRORED, mirrored, index),
        ):
            if not len(among):
                continue
            walk.take(technique, among, rule, Alone())
            event = walk.step(Frame(image=changed(image, rng, looks_down), name=frame.name, t_mono_s=0.0))
            if event.evidence is None:
                continue
            best = int(np.flatnonzero(index.place_ids == event.best.place.place_id)[0])
            right = way == THERE and not elsewhere(index, slot, np.array([best]), rule.neighbour_m)[0]
            yield Answer(place_id=place_id, way=way, right=bool(right), evidence=event.evidence)


def calibrate(
    technique: Technique,
    place_map: PlaceMap,
    config: MatchConfig,
    meter: QueryMeter,
    pictures: Callable[[Sequence[str]], Iterable[Frame]],
    watch: Watch,
) -> Calibration | None:
    """Calibrate a map that is open for adding, and record it there. `pictures` gives the frames of these names, of
    which the map was made, as far as they are at hand. None where the technique is judged by its limits, the map has
    too few places, or there are no pictures: the shipped model is then used. Raises MapError for a file that cannot be
    read or written.
    """
    kinds = kinds_of(technique.spec)
    places = list(place_map.places()) if kinds else []
    if len(places) < FEWEST_PLACES:
        return None
    ids = {place.source_image: place.place_id for place in places}
    names = sorted(ids)
    names = [names[at] for at in np.random.default_rng(_SEED).permutation(len(names))[:ASKED].tolist()]
    rounds = -(-ASKED // len(names))
    index = load_index(place_map, technique, len(places) * bytes_per_place(technique.spec))
    rule = accept_rule(technique, config)
    answers: list[Answer] = []
    for _ in range(rounds):
        frames = watch(pictures(names), len(names))
        answers.extend(ask(technique, place_map, index, rule, meter, frames, ids, seed=len(answers)))
    kind = kind_of(answers[0].evidence) if answers else kinds[0]
    answers = [each for each in answers if kind_of(each.evidence) == kind]
    if not answers:
        return None
    model = adapted(prior(kind), answers, f"{len(answers)} answers of the map itself")
    threshold = model.threshold(config.accept_precision)
    sure = [model.confidence(each.evidence) for each in answers]
    there = [each.way == THERE for each in answers]
    found = Calibration(
        models={kind: model},
        made=model.made,
        asked=sum(there),
        precision=config.accept_precision,
        accepted=float(np.mean([c >= threshold for c, each in zip(sure, answers, strict=True) if each.way == THERE])),
        accepted_wrong=sum(c >= threshold and not each.right for c, each in zip(sure, answers, strict=True)),
        recognisable=_by_place(answers, sure),
    )
    place_map.record_calibration(as_text(found))
    return found


def _by_place(answers: Sequence[Answer], sure: Sequence[float]) -> dict[int, float]:
    """Return the mean confidence of each place that was asked for; one that was taken for another counts as 0."""
    of_place: dict[int, list[float]] = {}
    for answer, confidence in zip(answers, sure, strict=True):
        if answer.way == THERE:
            of_place.setdefault(answer.place_id, []).append(confidence if answer.right else 0.0)
    return {place_id: round(float(np.mean(each)), 4) for place_id, each in sorted(of_place.items())}


def adapted(model: Model, answers: Iterable[Answer], made_of: str) -> Model:
    """Return a model for the map that gave these answers."""
    answers = list(answers)
    right = [each for each in answers if each.right]
    nowhere = [each for each in answers if each.way == MIRRORED]
    of_map = _adapted(model.of_map, right, nowhere, 1.0, _PULL_OF_MAP)
    wrong = [each for each in answers if each.way == THERE and not each.right]
    left_out = [each for each in answers if each.way == LEFT_OUT]
    of_place = _adapted(model.of_place, right + wrong, left_out, _LEFT_OUT_COUNTS, _PULL_OF_PLACE)
    scale = model.adapted_scale or model.scale
    today = date.today().isoformat()
    return Model(of_map=of_map, of_place=of_place, scale=scale, made=today, made_of=made_of)


def _adapted(
    start: Logistic, found: Sequence[Answer], beside: Sequence[Answer], counts: float, pull: float
) -> Logistic:
    answers = [*found, *beside]
    right = np.array([each.right for each in answers], bool)
    weights = np.repeat([1.0, counts], [len(found), len(beside)])
    return fitted(start, [each.evidence for each in answers], right, weights, pull)


def _same_ground(place_map: PlaceMap, index: PlaceIndex, slot: int, neighbour_m: float) -> np.ndarray:
    """Tell which places may show ground of this one, bool (N,)."""
    away_m = distance_m(index.lat_deg[slot], index.lon_deg[slot], index.lat_deg, index.lon_deg)
    near_m = max(neighbour_m, place_map.footprint_m() or 0.0)
    beside = abs(np.arange(len(index)) - slot) <= _BESIDE_PLACES
    return np.where(np.isnan(away_m), beside, away_m <= near_m)


def _without(index: PlaceIndex, left_out: np.ndarray) -> PlaceIndex:
    return PlaceIndex(**{name: array[~left_out] for name, array in index.arrays.items()}, mean=index.mean)
