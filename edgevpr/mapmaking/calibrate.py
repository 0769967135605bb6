"""Calibrates a map: makes queries with known answers from the map's own pictures, and fits the confidence model to the
results. This model computes the probability that a match is correct from its *evidence*: named measurements, such as
score and margin.

Each picture is altered as if taken on another day and in another season (see `changes`), then searched for in the map
in three ways:
* THERE: its place is in the map.
* LEFT_OUT: its place and all that may show the same ground are removed. The best match is a similar-looking place.
* MIRRORED: the query is its mirror image, which shows ground that exists nowhere but resembles the terrain of the map.
  It is used only for the figures reported for the map.
The results show how similar the places of this map look. So the fit adjusts the part of the *shipped* (default) model
that decides which place it is (`Model.of_place`), and only as far as the results demand. The part that decides whether
the query shows mapped ground is not changed: pictures of other ground agree by chance about equally in every map."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import outside_neighbourhood
from edgevpr.places.rows import escape_name
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.calibration import MIN_PLACES, MapCalibration, format_calibration
from edgevpr.runtime.recognise.confidence import Figures, Logistic, Model, read_default_model
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
from edgevpr.runtime.recognise.judge import ConfidenceRule, make_accept_rule

Pictures = Callable[[Sequence[str]], Iterable[Frame]]  # yields the available frames with these names

THERE = "there"
LEFT_OUT = "left out"
MIRRORED = "mirrored"
FORWARD_QUERIES = 120
NADIR_QUERIES = 60  # fewer, because each query takes longer
_MAX_WITHOUT_POSITION = 0.2  # fraction of places; in nadir maps the order of pictures does not reveal overlaps
_LEFT_OUT_WEIGHT = 0.3  # weight of LEFT_OUT results, because flights outside the map are rarer
# Prior precisions of weights and bias around the default model (see `fit_logistic`). Chosen on corridor and
# sat_marash, while monitoring the other sets. With a nadir camera, a precision of 5 and a free bias, the random draw of
# pictures decided whether 14 or 39 of 80 queries of sat_marash were accepted. With a forward camera, a prior on the
# bias halves the number of queries accepted on corridor.
_PRIOR_PRECISIONS = {AHEAD: (50.0, 0.0), AHEAD_PROVEN: (50.0, 0.0), DOWN: (200.0, 200.0), DOWN_BARE: (200.0, 200.0)}
_SEED = 15
_LOW_PRECISION = 0.5  # required precision at which hardly any match is rejected for low confidence


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryResult:
    """Result of one query made from a picture of the map. `place_id`: the place of this picture. `way`: how the query
    was made (THERE, LEFT_OUT, MIRRORED). `right`: the best match is the correct place. `evidence`: the evidence for the
    best match (None: the picture has too little texture to search for). `refused`: the match was rejected for a reason
    other than low confidence."""

    place_id: int
    way: str
    right: bool
    evidence: Evidence | None
    refused: bool = False


def query_map(search: MapSearch, pictures: Iterable[tuple[int, LevelledImage]]) -> Iterator[QueryResult]:
    """Query the map with altered pictures of its own places, in all three ways, and yield the results. `pictures` are
    pairs of a place id and its picture as encoded for the map. Places that are not in the index are skipped."""
    rng = np.random.default_rng((_SEED, 0))
    assert search.rule.confidence_rule is not None  # set for techniques with a confidence model
    low_precision_rule = replace(search.rule.confidence_rule, precision=_LOW_PRECISION)
    search = search.replace_rule(confidence_rule=low_precision_rule)
    index, looks_down = search.index, search.technique.spec.looks_down
    for place_id, picture in pictures:
        if (slot := search.slots.get(place_id)) is None:
            continue
        same_ground = search.find_same_ground(slot)
        mirrored_mask = None if picture.mask is None else np.ascontiguousarray(picture.mask[:, ::-1])
        mirrored = LevelledImage(np.ascontiguousarray(picture.image[:, ::-1]), mirrored_mask, picture.view)
        ways = ((THERE, picture, index), (LEFT_OUT, picture, index.select(~same_ground)), (MIRRORED, mirrored, index))
        for way, original, candidates in ways:
            if not len(candidates):
                continue
            image, mask = change_picture(original.image, rng, looks_down, original.mask)
            event = search.find(place_id, image, mask, candidates)
            if event.evidence is None or event.best is None or event.confidence is None:
                yield QueryResult(place_id=place_id, way=way, right=False, evidence=None)
                continue
            best = search.slots[event.best.place.place_id]
            max_slots = count_neighbours(search.rule.look_alikes)
            right = (
                way == THERE
                and not outside_neighbourhood(index, slot, np.array([best]), search.near_m, max_slots=max_slots)[0]
            )
            if way == THERE and not right and same_ground[best] and not np.isnan(index.lat_deg[best]):
                continue  # the two pictures may overlap, so it is unknown whether the match is correct
            refused = not event.accepted and event.confidence >= low_precision_rule.threshold(event.evidence)
            yield QueryResult(place_id=place_id, way=way, right=bool(right), evidence=event.evidence, refused=refused)


def calibrate(
    encoder: FrameEncoder,
    place_map: PlaceMap,
    config: MatchConfig,
    meter: QueryMeter,
    pictures: Pictures,
    progress: Progress,
) -> MapCalibration:
    """Calibrate a map that is open for writing, and store the result in it. `pictures` reads the pictures with the
    given names; `progress` wraps the iteration over these frames to report progress. `encoder`: the one that made the
    map.
    A map of fewer than MIN_PLACES keeps the default models: its results are too few to fit them. Raises UsageError if
    the technique has no confidence model, the map has too few places (looking down), or too few of their pictures are
    found. Raises MapError if the map file cannot be read or written."""

    def require(condition: object, problem: str) -> None:
        if not condition:
            raise UsageError(f"{place_map.path} cannot be calibrated: {problem}.")

    technique = encoder.technique
    kinds = list_evidence_kinds(technique.spec)
    require(kinds, f"{technique.spec.name} judges matches by score and margin; only `cohog` computes a confidence")
    search = MapSearch(place_map, technique, make_accept_rule(technique, config), meter)
    index, looks_down = search.index, technique.spec.looks_down
    min_places = MIN_PLACES if looks_down else max(1, min(len(index), MIN_PLACES))
    require(len(index) >= min_places, f"it has {len(index)} places, but {min_places} are needed")
    has_positions = not looks_down or np.isnan(index.lat_deg).mean() <= _MAX_WITHOUT_POSITION
    require(has_positions, "too many places lack a position, so it is unknown which of them show the same ground")
    if not looks_down:
        encoded = _encode_pictures(encoder, place_map, pictures, progress, len(place_map))
        descriptors = ((place_id, frame.descriptor) for place_id, frame in encoded)
        search = search.replace_rule(look_alikes=measure_look_alikes(search, descriptors))
    count = count_queries(technique) if len(index) >= MIN_PLACES else len(index)
    encoded = _encode_pictures(encoder, place_map, pictures, progress, count)
    results = list(query_map(search, ((place_id, frame.picture) for place_id, frame in encoded)))
    place_count = len({result.place_id for result in results})
    require(
        place_count >= min_places,
        f"pictures of only {place_count} places were found, but {min_places} are needed; pass the pictures that it was "
        "made from, with the same `source.fov_deg` (--fov-deg) or lens, `up_deg` and mask",
    )
    models = {kind: read_default_model(kind) for kind in kinds}
    calibration = _fit_calibration(results, models, config.accept_precision, can_fit=len(index) >= MIN_PLACES)
    calibration = replace(calibration, look_alikes=search.rule.look_alikes)
    place_map.record_calibration(format_calibration(calibration))
    return calibration


def count_queries(technique: Technique) -> int:
    """Return the number of pictures used to calibrate a map of this technique."""
    return NADIR_QUERIES if technique.spec.looks_down else FORWARD_QUERIES


def _encode_pictures(
    encoder: FrameEncoder, place_map: PlaceMap, pictures: Pictures, progress: Progress, count: int
) -> Iterator[tuple[int, EncodedFrame]]:
    """Yield (place id, its picture as encoded for the map) for `count` pictures in random order, starting over if there
    are fewer. A picture whose name matches that of a place, but whose content differs, is skipped."""
    ids_by_image = {name: ids for (name,), ids in place_map.select_ids("source_image").items() if isinstance(name, str)}
    names = sorted(ids_by_image)
    names = [names[index] for index in np.random.default_rng(_SEED).permutation(len(names)).tolist()]
    frames = (frame for done in range(0, count, max(len(names), 1)) for frame in pictures(names[: count - done]))
    for frame in progress(frames, count, "calibrating"):
        encoded = encoder.encode(frame)
        for place_id in ids_by_image.get(escape_name(frame.name), ()):
            if place_map.has_descriptor(place_id, encoded.descriptor.coarse):
                yield place_id, encoded
                break


def _fit_calibration(
    results: Sequence[QueryResult], models: Mapping[str, Model], precision: float, can_fit: bool
) -> MapCalibration:
    """Fit the default `models` to the results if `can_fit`, and count the matches accepted at this `precision`."""
    if can_fit:
        made_of = f"{sum(result.evidence is not None for result in results)} answers of the map itself"
        models = {kind: adapt_model(model, kind, results, made_of) for kind, model in models.items()}
    rule = ConfidenceRule(models, precision)
    accepted = [
        result
        for result in results
        if (data := result.evidence) and not result.refused and rule.confidence(data) >= rule.threshold(data)
    ]
    in_map = [result for result in results if result.way == THERE]
    confidences: dict[int, list[float]] = {}  # of the queries of each place; 0 for a wrong or rejected match
    for result in in_map:
        evidence = result.evidence if result.right and not result.refused else None
        confidences.setdefault(result.place_id, []).append(rule.confidence(evidence) if evidence else 0.0)
    return MapCalibration(
        models=models if can_fit else {},
        made=date.today().isoformat(),
        asked=len(in_map),
        precision=precision,
        accepted=sum(result.way == THERE for result in accepted) / max(len(in_map), 1),
        accepted_wrong=sum(not result.right for result in accepted),
        recognisable={place_id: round(float(np.mean(values)), 4) for place_id, values in sorted(confidences.items())},
    )


def adapt_model(model: Model, kind: str, results: Iterable[QueryResult], made_of: str) -> Model:
    """Return a copy of `model`, the confidence model for this kind of evidence, with its `of_place` fitted to the
    results of a map. Results without evidence are ignored. `made_of`: note on the data, stored in the model."""
    usable = [(result, result.evidence) for result in results if result.evidence and result.way != MIRRORED]
    # If the landmarks of the best place were not compared, no landmarks agree.
    rows = [{"landmarks": 0.0} | evidence.figures() for _, evidence in usable]
    right = np.array([result.right for result, _ in usable], bool)
    of_place = model.of_place
    if not right.all():  # a fit needs wrong matches too
        weights = np.array([_LEFT_OUT_WEIGHT if result.way == LEFT_OUT else 1.0 for result, _ in usable])
        of_place = fit_logistic(of_place, rows, right, weights, *_PRIOR_PRECISIONS[kind])
    scale = model.adapted_scale or model.scale
    made = date.today().isoformat()
    return Model(of_map=model.of_map, of_place=of_place, scale=scale, made=made, made_of=made_of, matches=model.matches)


def fit_logistic(
    start: Logistic,
    rows: Sequence[Figures],
    right: Bools,
    weights: Doubles,
    precision: float,
    bias_precision: float = 0.0,
) -> Logistic:
    """Fit a logistic regression to N `rows` of evidence. `right`, bool (N,), is True for correct matches; `weights`,
    float (N,), are the weights of the rows.

    Gaussian priors keep the regression near `start`: variance 1 / `precision` for its scaled coefficients, and
    1 / `bias_precision` for its bias (0: the bias is free). With few rows, the result stays close to `start`."""
    scales, features = np.array(start.scales), make_evidence_matrix(rows, start.names) / np.array(start.scales)
    prior_mean = np.append(np.array(start.weights) * scales, start.bias)
    precisions = np.append(np.full(len(scales), precision), bias_precision)
    sign = np.where(right, 1.0, -1.0)

    def cost(params: Doubles) -> tuple[float, Doubles]:
        logit = features @ params[:-1] + params[-1]
        offset = params - prior_mean
        loss = weights @ np.logaddexp(0, -sign * logit) + precisions / 2 @ (offset * offset)
        slope = -weights * sign * np.exp(-np.logaddexp(0, sign * logit))
        return float(loss), np.append(features.T @ slope, slope.sum()) + precisions * offset

    solution = minimize(cost, prior_mean, jac=True, method="L-BFGS-B").x
    return Logistic(start.names, tuple((solution[:-1] / scales).tolist()), start.scales, float(solution[-1]))


def make_evidence_matrix(rows: Sequence[Figures], names: Sequence[str]) -> Doubles:
    """Return the evidence of N matches as a matrix, float64 (N, F), with one column for each of the F `names`."""
    return np.array([[row[name] for name in names] for row in rows], float).reshape(len(rows), len(names))
