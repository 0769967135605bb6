"""Calibration of a map: it is asked for changed pictures of its own places, and how sure it can be is fitted to the
answers.

Each picture is asked for three times. As it is, it is of a place that the map has. Then that place and all that may
show the same ground are left out: the best match is one of the look-alikes that every map has. At last the picture is
mirrored: it shows ground that is nowhere, as the same camera would see it in the same country. What the shipped model
knows from many sites stays, as far as the answers do not say otherwise.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import TypeVar

import numpy as np

from edgevpr.core.config import MatchConfig
from edgevpr.core.contract import Technique
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Frame
from edgevpr.frames.level import Levelled
from edgevpr.frames.mask import AnyMask, Mask, NoMask, encoded
from edgevpr.mapmaking.changes import changed
from edgevpr.mapmaking.fit import fitted
from edgevpr.places.index import PlaceIndex, bytes_per_place, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import elsewhere
from edgevpr.places.rows import readable
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.confidence import Evidence, Logistic, Model, prior
from edgevpr.runtime.recognise.evidence import kind_of, kinds_of
from edgevpr.runtime.recognise.judge import AcceptRule, Sureness, accept_rule
from edgevpr.runtime.recognise.levelling import AnyLevelling, NoLevelling
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.stored_confidence import FEWEST_PLACES, Calibration, as_text

T = TypeVar("T")
Watch = Callable[[Iterable[T], int], Iterable[T]]
Pictures = Callable[[Sequence[str]], Iterable[Frame]]  # the frames of these names, as far as they are at hand

THERE, LEFT_OUT, MIRRORED = "there", "left out", "mirrored"
ASKED_AHEAD, ASKED_DOWN = 120, 60  # pictures; looking down, most are looked for from five heights
_BESIDE_PLACES = 10  # before and after a place without position: they may show the same ground
_MOST_WITHOUT_POSITION = 0.2  # of the places of a map that looks down, whose pictures overlap in any order
_OVERLAPS = 2.0  # footprints: so far apart a higher and a lower picture, turned, have no ground in common
_LEFT_OUT_COUNTS = 0.3  # over ground that is not in the map nobody flies as often
# How far a map moves the shipped weights; chosen on corridor, with grief_stromovka_seasons and nordland_tiny in view.
_PULL_OF_MAP, _PULL_OF_PLACE = 20.0, 5.0
_SEED = 15
_EVEN = 0.5  # precision at which hardly anything is refused for want of confidence


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """The answer to one question of a map: of which place the picture was, in which `way` it was asked for (THERE,
    LEFT_OUT, MIRRORED), whether the best place was `right`, and its evidence (None: the picture says too little to look
    for it). `refused`: something beside the confidence speaks against the best place."""

    place_id: int
    way: str
    right: bool
    evidence: Evidence | None
    refused: bool = False


def ask(
    technique: Technique,
    place_map: PlaceMap,
    index: PlaceIndex,
    rule: AcceptRule,
    meter: QueryMeter,
    pictures: Iterable[tuple[int, Levelled]],
    seed: int = 0,
) -> Iterator[Answer]:
    """Ask a map for changed pictures of its own places, in each way. `pictures` are numbers of places with the pictures
    that they were made of, as they were encoded then. A place that is not in the index is left out."""
    rng = np.random.default_rng((_SEED, seed))
    rule = replace(rule, sure=replace(rule.sure, precision=_EVEN))
    looks_down = technique.spec.cells is not None
    near_m = max(rule.neighbour_m, place_map.footprint_m() or index.spacing_m() or 0.0)
    slots = {int(place_id): slot for slot, place_id in enumerate(index.place_ids)}
    for place_id, picture in pictures:
        if (slot := slots.get(place_id)) is None:
            continue
        may_be_same = _same_ground(index, slot, near_m)
        others = _without(index, may_be_same)
        for way, seen, among in (
            (THERE, picture, index),
            (LEFT_OUT, picture, others),
            (MIRRORED, _mirrored(picture), index),
        ):
            if not len(among):
                continue
            image, shown = changed(seen.image, rng, looks_down, seen.mask)
            walk = Recogniser(
                technique=technique,
                place_map=place_map,
                index=among,
                rule=rule,
                meter=meter,
                candidates=technique.candidates,
                mask=None if shown is None else Mask(shown, sha256=""),
            )
            event = walk.step(Frame(image=image, name=f"place {place_id}", t_mono_s=0.0))
            if event.evidence is None:
                yield Answer(place_id=place_id, way=way, right=False, evidence=None)
                continue
            best = int(np.flatnonzero(index.place_ids == event.best.place.place_id)[0])
            right = way == THERE and not elsewhere(index, slot, np.array([best]), near_m)[0]
            if way == THERE and not right and may_be_same[best] and not np.isnan(index.lat_deg[best]):
                continue  # their pictures may overlap: nobody knows whether it is right
            refused = not event.accepted and event.confidence >= rule.sure.threshold(event.evidence)
            yield Answer(place_id=place_id, way=way, right=bool(right), evidence=event.evidence, refused=refused)


def calibrate(
    technique: Technique,
    place_map: PlaceMap,
    config: MatchConfig,
    meter: QueryMeter,
    pictures: Pictures,
    watch: Watch,
    mask: AnyMask | None = None,
    levelling: AnyLevelling | None = None,
) -> Calibration:
    """Calibrate a map that is open for adding, and record it there. `mask` and `levelling` are those that the map was
    made with. Raises UsageError where the technique is judged by its limits, the map has too few places, or too few of
    their pictures are at hand: the shipped model is then used. Raises MapError for a file that cannot be read or
    written.
    """
    kinds = kinds_of(technique.spec)
    if not kinds:
        raise UsageError(
            f"{place_map.path} is of {technique.spec.name}, whose matches are judged by score and margin: only `cohog` "
            "has a confidence to calibrate."
        )
    index = load_index(place_map, technique, len(place_map) * bytes_per_place(technique.spec))
    if len(index) < FEWEST_PLACES:
        raise UsageError(
            f"{place_map.path} has {len(index)} places, and {FEWEST_PLACES} are needed to calibrate it: the shipped "
            "confidence is used."
        )
    if technique.spec.cells is not None and np.isnan(index.lat_deg).mean() > _MOST_WITHOUT_POSITION:
        raise UsageError(
            f"{place_map.path}: its places have no positions, so nobody knows which of them show the same ground: the "
            "shipped confidence is used."
        )
    mask, levelling = mask or NoMask(), levelling or NoLevelling()
    ids = {name: found for (name,), found in place_map.ids_by("source_image").items() if isinstance(name, str)}
    names = sorted(ids)
    names = [names[at] for at in np.random.default_rng(_SEED).permutation(len(names)).tolist()]

    count = asked_of(technique)

    def asked() -> Iterator[Frame]:
        for done in range(0, count, len(names)):
            yield from pictures(names[: count - done])

    def as_mapped() -> Iterator[tuple[int, Levelled]]:
        """Yield what is really the picture of a place: another folder may have the same names."""
        for frame in watch(asked(), count):
            picture = levelling.prepare(frame, None, mask.fitted(frame.image))
            coarse = encoded(technique, picture.image, picture.mask).coarse
            found = (each for each in ids.get(readable(frame.name), ()) if place_map.is_of(each, coarse))
            if (place_id := next(found, None)) is not None:
                yield place_id, picture

    rule = accept_rule(technique, config)
    answers = list(ask(technique, place_map, index, rule, meter, as_mapped()))
    at_hand = len({each.place_id for each in answers})
    if at_hand < FEWEST_PLACES:
        raise UsageError(
            f"Of {place_map.path} the pictures of {at_hand} places are at hand, and those of {FEWEST_PLACES} are "
            "needed: give the pictures that it was made of, with the same camera and mask."
        )
    found = _calibration(answers, kinds, config.accept_precision)
    place_map.record_calibration(as_text(found))
    return found


def asked_of(technique: Technique) -> int:
    """Return how many pictures a map of this technique is asked for."""
    return ASKED_AHEAD if technique.spec.cells is None else ASKED_DOWN


def _calibration(answers: Sequence[Answer], kinds: Sequence[str], precision: float) -> Calibration:
    """Fit the model of the kind of evidence that most answers have, and count what it accepts."""
    counts = Counter(kind_of(each.evidence) for each in answers if each.evidence)
    kind = max(kinds, key=lambda each: counts[each])
    mine = [each for each in answers if each.evidence and kind_of(each.evidence) == kind]
    model = adapted(prior(kind), mine, f"{len(mine)} answers of the map itself")
    sure = Sureness({each: prior(each) for each in kinds} | {kind: model}, precision)

    def is_accepted(answer: Answer) -> bool:
        return (
            answer.evidence is not None
            and not answer.refused
            and sure.confidence(answer.evidence) >= sure.threshold(answer.evidence)
        )

    accepted = [each for each in answers if is_accepted(each)]
    asked = sum(each.way == THERE for each in answers)
    return Calibration(
        models={kind: model},
        made=date.today().isoformat(),
        asked=asked,
        precision=precision,
        accepted=sum(each.way == THERE for each in accepted) / asked,
        accepted_wrong=sum(not each.right for each in accepted),
        recognisable=_by_place(answers, sure),
    )


def _by_place(answers: Sequence[Answer], sure: Sureness) -> dict[int, float]:
    """Return the mean confidence of each place that was asked for. A match that is wrong or refused counts as 0."""
    of_place: dict[int, list[float]] = {}
    for answer in answers:
        if answer.way == THERE:
            confidence = sure.confidence(answer.evidence) if answer.right and not answer.refused else 0.0
            of_place.setdefault(answer.place_id, []).append(confidence)
    return {place_id: round(float(np.mean(each)), 4) for place_id, each in sorted(of_place.items())}


def adapted(model: Model, answers: Iterable[Answer], made_of: str) -> Model:
    """Return a model for the map that gave these answers, which all have evidence."""
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
    if all(each.right for each in answers):  # they say nothing of how a wrong one could be told
        return start
    right = np.array([each.right for each in answers], bool)
    weights = np.repeat([1.0, counts], [len(found), len(beside)])
    return fitted(start, [each.evidence for each in answers], right, weights, pull)


def _mirrored(picture: Levelled) -> Levelled:
    image, mask = (
        None if each is None else np.ascontiguousarray(each[:, ::-1]) for each in (picture.image, picture.mask)
    )
    return Levelled(image, mask, picture.view)


def _same_ground(index: PlaceIndex, slot: int, near_m: float) -> np.ndarray:
    """Tell which places may show ground of this one, bool (N,); `near_m` is the ground that a picture shows."""
    away_m = distance_m(index.lat_deg[slot], index.lon_deg[slot], index.lat_deg, index.lon_deg)
    beside = abs(np.arange(len(index)) - slot) <= _BESIDE_PLACES
    return np.where(np.isnan(away_m), beside, away_m <= _OVERLAPS * near_m)


def _without(index: PlaceIndex, left_out: np.ndarray) -> PlaceIndex:
    return PlaceIndex(**{name: array[~left_out] for name, array in index.arrays.items()}, mean=index.mean)
