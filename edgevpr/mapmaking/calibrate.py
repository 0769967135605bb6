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

import numpy as np
from scipy.optimize import minimize

from edgevpr.core.config import MatchConfig
from edgevpr.core.contract import Technique
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Frame
from edgevpr.frames.level import Levelled
from edgevpr.frames.mask import Mask, encoded
from edgevpr.mapmaking.changes import changed
from edgevpr.mapmaking.mapping import Watch
from edgevpr.places.index import PlaceIndex, bytes_per_place, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import elsewhere
from edgevpr.places.rows import readable
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.confidence import Evidence, Logistic, Model, prior
from edgevpr.runtime.recognise.evidence import FEWEST_PLACES, MapCalibration, calibration_text, kind_of, kinds_of
from edgevpr.runtime.recognise.judge import AcceptRule, Sureness, accept_rule
from edgevpr.runtime.recognise.recogniser import Matcher, Preparation, Recogniser, WalkSettings

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
class MapAnswer:
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
) -> Iterator[MapAnswer]:
    """Ask a map for changed pictures of its own places, in each way. `pictures` are numbers of places with the pictures
    that they were made of, as they were encoded then. A place that is not in the index is left out."""
    rng = np.random.default_rng((_SEED, seed))
    assert rule.sure is not None  # of a technique that has a confidence
    sure = replace(rule.sure, precision=_EVEN)
    rule = replace(rule, sure=sure)
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
                Matcher(technique, among, rule),
                place_map,
                meter,
                WalkSettings(candidates=technique.candidates),
                preparation=Preparation(mask=None if shown is None else Mask(shown, sha256="")),
            )
            event = walk.step(Frame(image=image, name=f"place {place_id}", t_mono_s=0.0))
            if event.evidence is None or event.best is None or event.confidence is None:
                yield MapAnswer(place_id=place_id, way=way, right=False, evidence=None)
                continue
            best = int(np.flatnonzero(index.place_ids == event.best.place.place_id)[0])
            right = way == THERE and not elsewhere(index, slot, np.array([best]), near_m)[0]
            if way == THERE and not right and may_be_same[best] and not np.isnan(index.lat_deg[best]):
                continue  # their pictures may overlap: nobody knows whether it is right
            refused = not event.accepted and event.confidence >= sure.threshold(event.evidence)
            yield MapAnswer(place_id=place_id, way=way, right=bool(right), evidence=event.evidence, refused=refused)


def calibrate(
    technique: Technique,
    place_map: PlaceMap,
    config: MatchConfig,
    meter: QueryMeter,
    pictures: Pictures,
    watch: Watch[Frame],
    preparation: Preparation | None = None,
) -> MapCalibration:
    """Calibrate a map that is open for adding, and record it there. `preparation` is that which the map was made with.
    Raises UsageError where the technique is judged by its limits, the map has too few places, or too few of their
    pictures are at hand: the shipped model is then used. Raises MapError for a file that cannot be read or written.
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
    as_mapped = _as_mapped(technique, place_map, pictures, watch, preparation or Preparation())
    answers = list(ask(technique, place_map, index, accept_rule(technique, config), meter, as_mapped))
    at_hand = len({answer.place_id for answer in answers})
    if at_hand < FEWEST_PLACES:
        raise UsageError(
            f"Of {place_map.path} the pictures of {at_hand} places are at hand, and those of {FEWEST_PLACES} are "
            "needed: give the pictures that it was made of, with the same camera and mask."
        )
    calibration = _calibration(answers, kinds, config.accept_precision)
    place_map.record_calibration(calibration_text(calibration))
    return calibration


def asked_of(technique: Technique) -> int:
    """Return how many pictures a map of this technique is asked for."""
    return ASKED_AHEAD if technique.spec.cells is None else ASKED_DOWN


def _as_mapped(
    technique: Technique, place_map: PlaceMap, pictures: Pictures, watch: Watch[Frame], preparation: Preparation
) -> Iterator[tuple[int, Levelled]]:
    """Yield places with what is really their picture: another folder may have the same names."""
    ids_by_image = {name: ids for (name,), ids in place_map.ids_by("source_image").items() if isinstance(name, str)}
    names = sorted(ids_by_image)
    names = [names[at] for at in np.random.default_rng(_SEED).permutation(len(names)).tolist()]
    count = asked_of(technique)
    frames = (frame for done in range(0, count, len(names)) for frame in pictures(names[: count - done]))
    for frame in watch(frames, count):
        picture = preparation.picture(frame)
        coarse = encoded(technique, picture.image, picture.mask).coarse
        of_name = ids_by_image.get(readable(frame.name), ())
        if (place_id := next((at for at in of_name if place_map.is_of(at, coarse)), None)) is not None:
            yield place_id, picture


def _calibration(answers: Sequence[MapAnswer], kinds: Sequence[str], precision: float) -> MapCalibration:
    """Fit the model of the kind of evidence that most answers have, and count what it accepts."""
    counts = Counter(kind_of(answer.evidence) for answer in answers if answer.evidence)
    kind = max(kinds, key=lambda kind: counts[kind])
    of_kind = [answer for answer in answers if answer.evidence and kind_of(answer.evidence) == kind]
    model = adapted(prior(kind), of_kind, f"{len(of_kind)} answers of the map itself")
    sure = Sureness({each: prior(each) for each in kinds} | {kind: model}, precision)
    accepted = [
        answer
        for answer in answers
        if (seen := answer.evidence) and not answer.refused and sure.confidence(seen) >= sure.threshold(seen)
    ]
    asked = sum(answer.way == THERE for answer in answers)
    return MapCalibration(
        models={kind: model},
        made=date.today().isoformat(),
        asked=asked,
        precision=precision,
        accepted=sum(answer.way == THERE for answer in accepted) / asked,
        accepted_wrong=sum(not answer.right for answer in accepted),
        recognisable=_by_place(answers, sure),
    )


def _by_place(answers: Sequence[MapAnswer], sure: Sureness) -> dict[int, float]:
    """Return the mean confidence of each place that was asked for. A match that is wrong or refused counts as 0."""
    of_place: dict[int, list[float]] = {}
    for answer in answers:
        if answer.way == THERE:
            seen = answer.evidence if answer.right and not answer.refused else None
            of_place.setdefault(answer.place_id, []).append(sure.confidence(seen) if seen else 0.0)
    return {place_id: round(float(np.mean(values)), 4) for place_id, values in sorted(of_place.items())}


def adapted(model: Model, answers: Iterable[MapAnswer], made_of: str) -> Model:
    """Return a model for the map that gave these answers; those without evidence say nothing."""
    answers = [answer for answer in answers if answer.evidence]
    right = [answer for answer in answers if answer.right]
    nowhere = [answer for answer in answers if answer.way == MIRRORED]
    wrong = [answer for answer in answers if answer.way == THERE and not answer.right]
    left_out = [answer for answer in answers if answer.way == LEFT_OUT]
    return Model(
        of_map=_adapted(model.of_map, right, nowhere, 1.0, _PULL_OF_MAP),
        of_place=_adapted(model.of_place, right + wrong, left_out, _LEFT_OUT_COUNTS, _PULL_OF_PLACE),
        scale=model.adapted_scale or model.scale,
        made=date.today().isoformat(),
        made_of=made_of,
    )


def _adapted(
    start: Logistic, found: Sequence[MapAnswer], beside: Sequence[MapAnswer], counts: float, pull: float
) -> Logistic:
    answers = [*found, *beside]
    if all(answer.right for answer in answers):  # they say nothing of how a wrong one could be told
        return start
    right = np.array([answer.right for answer in answers], bool)
    weights = np.repeat([1.0, counts], [len(found), len(beside)])
    return fitted(start, [answer.evidence for answer in answers if answer.evidence], right, weights, pull)


def fitted(start: Logistic, rows: Sequence[Evidence], right: np.ndarray, weights: np.ndarray, pull: float) -> Logistic:
    """Fit a logistic regression to rows that are `right` or not, bool (N,), with `weights` float (N,).

    The most probable one, where weights times scales are expected around those of `start` with the variance 1 / `pull`
    (a Gaussian prior; the bias is free). With few rows it stays at `start`.
    """
    scales, mine = np.array(start.scales), evidence_matrix(rows, start.names) / np.array(start.scales)
    middle = np.array(start.weights) * scales
    sign = np.where(right, 1.0, -1.0)

    def cost(at: np.ndarray) -> tuple[float, np.ndarray]:
        logit = mine @ at[:-1] + at[-1]
        off = at[:-1] - middle
        loss = weights @ np.logaddexp(0, -sign * logit) + pull / 2 * off @ off
        slope = -weights * sign * np.exp(-np.logaddexp(0, sign * logit))
        return float(loss), np.append(mine.T @ slope + pull * off, slope.sum())

    found = minimize(cost, np.append(middle, start.bias), jac=True, method="L-BFGS-B").x
    return Logistic(start.names, tuple((found[:-1] / scales).tolist()), start.scales, float(found[-1]))


def evidence_matrix(rows: Sequence[Evidence], names: Sequence[str]) -> np.ndarray:
    """Return evidence as a matrix, float64 (N, F)."""
    return np.array([[row[name] for name in names] for row in rows], float).reshape(len(rows), len(names))


def _mirrored(picture: Levelled) -> Levelled:
    mask = None if picture.mask is None else np.ascontiguousarray(picture.mask[:, ::-1])
    return Levelled(np.ascontiguousarray(picture.image[:, ::-1]), mask, picture.view)


def _same_ground(index: PlaceIndex, slot: int, near_m: float) -> np.ndarray:
    """Tell which places may show ground of this one, bool (N,); `near_m` is the ground that a picture shows."""
    away_m = distance_m(index.lat_deg[slot], index.lon_deg[slot], index.lat_deg, index.lon_deg)
    beside = abs(np.arange(len(index)) - slot) <= _BESIDE_PLACES
    return np.where(np.isnan(away_m), beside, away_m <= _OVERLAPS * near_m)


def _without(index: PlaceIndex, left_out: np.ndarray) -> PlaceIndex:
    return PlaceIndex(**{name: array[~left_out] for name, array in index.arrays.items()}, mean=index.mean)
