"""Calibration of a map: queries with known answers are made from the map's own pictures, and the confidence model is
fitted to the results. This model computes the probability that a match is right from the *evidence* of the match:
measurements by name, such as its score and margin.

Each picture is changed as by another day and season (see `changes`) and then looked for in the map in three ways:
* THERE: its place is in the map.
* LEFT_OUT: without its place and all that may show the same ground. The best match is then a similar-looking place.
* MIRRORED: as its mirror image, which shows ground that exists nowhere but looks like the country of the map. It only
  counts in the figures that are reported of the map.
The results show how much the places of this map look alike. So the fit moves the part of the shipped model that says
which place it is (`Model.of_place`), and only as far as the results demand. The part that says whether the query shows
ground of the map stays as shipped: pictures of foreign ground agree by chance to much the same degree in every map.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date

import numpy as np
from scipy.optimize import minimize

from edgevpr.core.arrays import Bools, Doubles
from edgevpr.core.config import MatchConfig
from edgevpr.core.contract import Technique
from edgevpr.core.errors import UsageError
from edgevpr.core.text import Progress
from edgevpr.core.types import Frame
from edgevpr.frames.level import LevelledImage
from edgevpr.mapmaking.changes import change_picture
from edgevpr.mapmaking.look_alikes import MapSearch, measure_look_alikes
from edgevpr.places.index import PlaceIndex, compute_place_bytes, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import outside_neighbourhood
from edgevpr.places.rows import escape_name
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.calibration import MIN_PLACES, MapCalibration, format_calibration
from edgevpr.runtime.recognise.confidence import Figures, Logistic, Model, read_shipped_model
from edgevpr.runtime.recognise.encoder import EncodedFrame, FrameEncoder
from edgevpr.runtime.recognise.evidence import (
    AHEAD,
    AHEAD_PROVEN,
    DOWN,
    DOWN_BARE,
    Evidence,
    count_neighbours,
    list_evidence_kinds,
)
from edgevpr.runtime.recognise.judge import AcceptRule, ConfidenceRule, make_accept_rule

Pictures = Callable[[Sequence[str]], Iterable[Frame]]  # yields the frames of these names, as far as they are found

THERE = "there"
LEFT_OUT = "left out"
MIRRORED = "mirrored"
FORWARD_QUERIES = 120
NADIR_QUERIES = 60  # each takes longer
_MAX_WITHOUT_POSITION = 0.2  # share of the places of a map that looks down, whose pictures overlap in any order
_LEFT_OUT_WEIGHT = 0.3  # weight of LEFT_OUT results: flights over ground outside the map are rarer
# Strength with which the fit holds on to the shipped weights, and to the bias (see `fit_logistic`). Chosen on corridor
# and sat_marash, with the other sets in view. Looking down, with 5 and a free bias, the pictures drawn by chance
# decided whether 14 or 39 of 80 queries of sat_marash were accepted; ahead, a bias that is held costs corridor half.
_PRIOR_PRECISIONS = {AHEAD: (50.0, 0.0), AHEAD_PROVEN: (50.0, 0.0), DOWN: (200.0, 200.0), DOWN_BARE: (200.0, 200.0)}
_SEED = 15
_EVEN_PRECISION = 0.5  # precision for which hardly any match is refused for low confidence


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryResult:
    """Result of one query made from a picture of the map. `place_id`: the place of this picture. `way`: how the query
    was made (THERE, LEFT_OUT, MIRRORED). `right`: the best match is the right place. `evidence`: that of the best match
    (None: the picture holds too little to be looked for). `refused`: the match was refused for another reason than low
    confidence."""

    place_id: int
    way: str
    right: bool
    evidence: Evidence | None
    refused: bool = False


def query_map(
    technique: Technique,
    place_map: PlaceMap,
    index: PlaceIndex,
    rule: AcceptRule,
    meter: QueryMeter,
    pictures: Iterable[tuple[int, LevelledImage]],
    seed: int = 0,
) -> Iterator[QueryResult]:
    """Run queries with changed pictures of the map's own places, in all three ways, and yield the results. `index` has
    the places of `place_map`, and `rule` is the rule for accepting a match. `pictures` are pairs of a place's number
    and its picture as it was encoded for the map. A place that is not in the index is left out."""
    rng = np.random.default_rng((_SEED, seed))
    assert rule.confidence_rule is not None  # set for a technique that has a confidence model
    even_rule = replace(rule.confidence_rule, precision=_EVEN_PRECISION)
    rule = replace(rule, confidence_rule=even_rule)
    search = MapSearch(technique, place_map, index, rule, meter=meter)
    for place_id, picture in pictures:
        if (slot := search.slots.get(place_id)) is None:
            continue
        may_be_same = search.find_same_ground(slot)
        ways = ((THERE, picture, index), (LEFT_OUT, picture, index.select(~may_be_same)))
        for way, seen, among in (*ways, (MIRRORED, _mirror_picture(picture), index)):
            if not len(among):
                continue
            image, shown = change_picture(seen.image, rng, technique.spec.looks_down, seen.mask)
            event = search.find(place_id, image, shown, among)
            if event.evidence is None or event.best is None or event.confidence is None:
                yield QueryResult(place_id=place_id, way=way, right=False, evidence=None)
                continue
            best = search.slots[event.best.place.place_id]
            beside = count_neighbours(rule.look_alikes)
            right = (
                way == THERE
                and not outside_neighbourhood(index, slot, np.array([best]), search.near_m, max_slots=beside)[0]
            )
            if way == THERE and not right and may_be_same[best] and not np.isnan(index.lat_deg[best]):
                continue  # the two pictures may overlap: it is unknown whether the match is right
            refused = not event.accepted and event.confidence >= even_rule.threshold(event.evidence)
            yield QueryResult(place_id=place_id, way=way, right=bool(right), evidence=event.evidence, refused=refused)


def calibrate(
    encoder: FrameEncoder,
    place_map: PlaceMap,
    config: MatchConfig,
    meter: QueryMeter,
    pictures: Pictures,
    progress: Progress,
) -> MapCalibration:
    """Calibrate a map that is open for adding, and store the result in the map. `pictures` opens the pictures of given
    names; `progress` wraps the iteration over these frames, to show progress. `encoder` is that with which the map was
    made.
    Raises UsageError if the technique has no confidence model, the map has too few places, or too few of their
    pictures are found. Raises MapError for a file that cannot be read or written.
    """

    def require(is_so: object, lacking: str) -> None:
        if not is_so:
            raise UsageError(f"{place_map.path} cannot be calibrated and flies with the shipped confidence: {lacking}.")

    technique = encoder.technique
    kinds = list_evidence_kinds(technique.spec)
    require(kinds, f"matches of {technique.spec.name} are judged by score and margin; only `cohog` has a confidence")
    index = load_index(place_map, technique, len(place_map) * compute_place_bytes(technique.spec))
    require(len(index) >= MIN_PLACES, f"it has {len(index)} places, and {MIN_PLACES} are needed")
    is_placed = not technique.spec.looks_down or np.isnan(index.lat_deg).mean() <= _MAX_WITHOUT_POSITION
    require(is_placed, "its places have no positions, so nobody knows which of them show the same ground")
    rule = make_accept_rule(technique, config)
    if not technique.spec.looks_down:
        near_m = MapSearch(technique, place_map, index, rule, meter=meter).near_m
        described = (
            (place_id, encoded.descriptor)
            for place_id, encoded in _read_mapped(encoder, place_map, pictures, progress, len(place_map))
        )
        rule = replace(rule, look_alikes=measure_look_alikes(technique, place_map, index, near_m, described))
    count = count_queries(technique)
    as_mapped = (
        (place_id, encoded.picture) for place_id, encoded in _read_mapped(encoder, place_map, pictures, progress, count)
    )
    answers = list(query_map(technique, place_map, index, rule, meter, as_mapped))
    at_hand = len({answer.place_id for answer in answers})
    require(
        at_hand >= MIN_PLACES,
        f"the pictures of {at_hand} places are at hand, and those of {MIN_PLACES} are needed; give the pictures "
        "that it was made of, with the same camera and mask",
    )
    calibration = replace(_fit_calibration(answers, kinds, config.accept_precision), look_alikes=rule.look_alikes)
    place_map.record_calibration(format_calibration(calibration))
    return calibration


def count_queries(technique: Technique) -> int:
    """Return the number of pictures that are used to calibrate a map of this technique."""
    return NADIR_QUERIES if technique.spec.looks_down else FORWARD_QUERIES


def _read_mapped(
    encoder: FrameEncoder, place_map: PlaceMap, pictures: Pictures, progress: Progress, count: int
) -> Iterator[tuple[int, EncodedFrame]]:
    """Yield (a place's number, its picture as it was encoded for the map) for `count` pictures in random order, again
    from the first one if there are fewer. A picture that has the name of a place's picture, but another content, is
    left out."""
    ids_by_image = {name: ids for (name,), ids in place_map.select_ids("source_image").items() if isinstance(name, str)}
    names = sorted(ids_by_image)
    names = [names[at] for at in np.random.default_rng(_SEED).permutation(len(names)).tolist()]
    frames = (frame for done in range(0, count, len(names)) for frame in pictures(names[: count - done]))
    for frame in progress(frames, count, "calibrating"):
        encoded = encoder.encode(frame)
        of_name = ids_by_image.get(escape_name(frame.name), ())
        if (
            place_id := next((at for at in of_name if place_map.has_descriptor(at, encoded.descriptor.coarse)), None)
        ) is not None:
            yield place_id, encoded


def _fit_calibration(answers: Sequence[QueryResult], kinds: Sequence[str], precision: float) -> MapCalibration:
    """Fit the models of all `kinds` of evidence to the answers, and count those that are accepted at the `precision`
    asked for."""
    known = [answer for answer in answers if answer.evidence]
    made_of = f"{len(known)} answers of the map itself"
    models = {kind: adapt_model(read_shipped_model(kind), kind, known, made_of) for kind in kinds}
    rule = ConfidenceRule(models, precision)
    accepted = [
        answer
        for answer in answers
        if (seen := answer.evidence) and not answer.refused and rule.confidence(seen) >= rule.threshold(seen)
    ]
    there = [answer for answer in answers if answer.way == THERE]
    of_place: dict[int, list[float]] = {}  # confidence of each query, 0 for a wrong or refused match
    for answer in there:
        seen = answer.evidence if answer.right and not answer.refused else None
        of_place.setdefault(answer.place_id, []).append(rule.confidence(seen) if seen else 0.0)
    return MapCalibration(
        models=models,
        made=date.today().isoformat(),
        asked=len(there),
        precision=precision,
        accepted=sum(answer.way == THERE for answer in accepted) / len(there),
        accepted_wrong=sum(not answer.right for answer in accepted),
        recognisable={place_id: round(float(np.mean(each)), 4) for place_id, each in sorted(of_place.items())},
    )


def adapt_model(model: Model, kind: str, answers: Iterable[QueryResult], made_of: str) -> Model:
    """Return a copy of the confidence model `model`, of this kind of evidence, with its `of_place` fitted to the
    answers of a map. Answers without evidence are ignored. `made_of`: a note, kept in the model, on the data that it
    was fitted to."""
    known = [(answer, answer.evidence) for answer in answers if answer.evidence and answer.way != MIRRORED]
    # A best place that was not worth a look at its landmarks has none that agree.
    rows = [{"landmarks": 0.0} | evidence.figures() for _, evidence in known]
    right = np.array([answer.right for answer, _ in known], bool)
    of_place = model.of_place
    if not right.all():  # wrong ones are needed to fit anything
        weights = np.array([_LEFT_OUT_WEIGHT if answer.way == LEFT_OUT else 1.0 for answer, _ in known])
        of_place = fit_logistic(of_place, rows, right, weights, *_PRIOR_PRECISIONS[kind])
    return Model(
        of_map=model.of_map,
        of_place=of_place,
        scale=model.adapted_scale or model.scale,
        made=date.today().isoformat(),
        made_of=made_of,
        matches=model.matches,
    )


def fit_logistic(
    start: Logistic,
    rows: Sequence[Figures],
    right: Bools,
    weights: Doubles,
    precision: float,
    bias_precision: float = 0.0,
) -> Logistic:
    """Fit a logistic regression to N `rows` of evidence, of which `right`, bool (N,), is True for right matches;
    `weights`, float (N,), are their weights.

    Gaussian priors hold the regression near `start`: its scaled coefficients with the variance 1 / `precision`, its
    bias with 1 / `bias_precision` (0: the bias is free). With few rows the result stays close to `start`.
    """
    scales, mine = np.array(start.scales), make_evidence_matrix(rows, start.names) / np.array(start.scales)
    middle = np.append(np.array(start.weights) * scales, start.bias)
    precisions = np.append(np.full(len(scales), precision), bias_precision)
    sign = np.where(right, 1.0, -1.0)

    def cost(at: Doubles) -> tuple[float, Doubles]:
        logit = mine @ at[:-1] + at[-1]
        off = at - middle
        loss = weights @ np.logaddexp(0, -sign * logit) + precisions / 2 @ (off * off)
        slope = -weights * sign * np.exp(-np.logaddexp(0, sign * logit))
        return float(loss), np.append(mine.T @ slope, slope.sum()) + precisions * off

    found = minimize(cost, middle, jac=True, method="L-BFGS-B").x
    return Logistic(start.names, tuple((found[:-1] / scales).tolist()), start.scales, float(found[-1]))


def make_evidence_matrix(rows: Sequence[Figures], names: Sequence[str]) -> Doubles:
    """Return the evidence of N matches as a matrix, float64 (N, F), with a column for each of the F `names`."""
    return np.array([[row[name] for name in names] for row in rows], float).reshape(len(rows), len(names))


def _mirror_picture(picture: LevelledImage) -> LevelledImage:
    mask = None if picture.mask is None else np.ascontiguousarray(picture.mask[:, ::-1])
    return LevelledImage(np.ascontiguousarray(picture.image[:, ::-1]), mask, picture.view)
