"""The model of confidence: evidence of a match in, the probability that the match is right out.

A match can be wrong in two ways: the query shows no ground of the map at all, or it does, and the best place is another
one. How well pictures agree by chance is much the same for every map; how much its places look alike is not. So there
is one logistic regression for each way. Both start from the shipped ones and are adapted to a map that is large enough
(see `calibrate`).

How many wrong matches go beyond a logit is known from many sites: the highest fall off as an exponential distribution
does (peaks over a threshold: Pickands 1975). Both ways together are the chance that a wrong match offers as much. The
threshold that a precision asks for is where that chance is what is left of 1, and the confidence is a probability made
of its logarithm (Platt 1999).
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

from edgevpr.core.errors import ModelError
from edgevpr.core.files import read_file, shipped

Evidence = Mapping[str, float]

_MAX_FILE_BYTES = 100_000
_MOST = 40.0  # of a logit: beyond, a probability is 0 or 1 in float64
# Of the share that may be wrong: without it foreign queries were accepted over grief_michigan_monthly, of five places.
_NOT_ADAPTED = 0.1
_LEAST = 1e-15  # of a chance whose logarithm is taken


@dataclass(frozen=True, slots=True)
class Logistic:
    """A logistic regression: the logit is `bias` plus the sum of `weights` times evidence, by their `names`. `scales`
    are the standard deviations of that evidence, over many sites."""

    names: tuple[str, ...]
    weights: tuple[float, ...]
    scales: tuple[float, ...]
    bias: float

    def __post_init__(self) -> None:
        if not len(self.names) == len(self.weights) == len(self.scales):
            raise ValueError("as many names as weights and scales are needed")
        if not all(map(math.isfinite, (*self.weights, *self.scales, self.bias))):
            raise ValueError("a weight is not finite")

    def logit(self, evidence: Evidence) -> float:
        return self.bias + sum(w * evidence[name] for w, name in zip(self.weights, self.names, strict=True))


@dataclass(frozen=True, slots=True)
class Tail:
    """The highest logits of wrong matches: the `share` of all matches is wrong and beyond `start`, and less by the
    factor e with every `scale` more."""

    start: float
    share: float
    scale: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.start) and 0 < self.scale < math.inf and 0 < self.share <= 1):
            raise ValueError("a tail needs a scale above 0, and a share above 0")

    def beyond(self, logit: float) -> float:
        """Return the share of matches that are wrong and beyond a logit; 1 at most."""
        return math.exp(min(0.0, math.log(self.share) + (self.start - logit) / self.scale))


@dataclass(frozen=True, slots=True)
class Scale:
    """Meaning of logits: the tails of wrong matches `off_map` and `off_place`, and the line that makes the logit of the
    confidence of the logarithm of the chance."""

    off_map: Tail
    off_place: Tail
    slope: float
    offset: float

    def __post_init__(self) -> None:
        if not (0 < self.slope < math.inf and math.isfinite(self.offset)):
            raise ValueError("more evidence must not make a match less probable")

    def confidence(self, chance: float) -> float:
        """Return the probability that a match is right, of the chance that a wrong one offers as much."""
        return probability(self.offset - self.slope * math.log(max(chance, _LEAST)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """Confidence of the matches of one technique and kind of evidence. `of_map` tells whether the query shows ground of
    the map, `of_place` whether the best place is the right one of it, and `scale` what these logits mean;
    `adapted_scale` is that of a model that is adapted to its map (None: this one is). `made` is the date, and `made_of`
    what it was fitted to, in words."""

    of_map: Logistic
    of_place: Logistic
    scale: Scale
    adapted_scale: Scale | None = None
    made: str
    made_of: str

    def chance(self, evidence: Evidence) -> float:
        """Return how likely a wrong match offers as much as this evidence, 0..1; 1 where some of it is not finite."""
        logits = self.of_map.logit(evidence), self.of_place.logit(evidence)
        if not all(map(math.isfinite, logits)):
            return 1.0
        return min(1.0, self.scale.off_map.beyond(logits[0]) + self.scale.off_place.beyond(logits[1]))

    def confidence(self, evidence: Evidence) -> float:
        """Return the probability that the match is right, 0..1."""
        return self.scale.confidence(self.chance(evidence))

    def confidence_of_map(self, evidence: Evidence) -> float:
        """Return the probability that the query shows ground of the map, whichever place of it, 0..1."""
        logit = self.of_map.logit(evidence)
        return self.scale.confidence(self.scale.off_map.beyond(logit) if math.isfinite(logit) else 1.0)

    def threshold(self, precision: float) -> float:
        """Return the confidence from which on `precision` (below 1) of the matches are right. A model that is not
        adapted to its map knows nothing of the look-alikes there, and asks for more."""
        wrong = 1 - precision
        return self.scale.confidence(wrong if self.adapted_scale is None else _NOT_ADAPTED * wrong)


def probability(logit: float) -> float:
    """Return the probability of a logit."""
    return 1 / (1 + math.exp(-max(-_MOST, min(_MOST, logit))))


def as_json(model: Model) -> str:
    """Write a model as JSON, as map files and shipped files have it."""
    return json.dumps(asdict(model))


def from_json(text: str) -> Model:
    """Read a model. Raises ValueError for a text that is none."""
    try:
        return model_of(json.loads(text))
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"no model of confidence ({error!r:.80})") from error


def model_of(stored: Mapping[str, Any]) -> Model:
    """Make a model of what JSON holds. Raises ValueError, KeyError or TypeError where that makes no sense."""
    adapted = stored["adapted_scale"]
    return Model(
        of_map=_logistic(**stored["of_map"]),
        of_place=_logistic(**stored["of_place"]),
        scale=_scale(**stored["scale"]),
        adapted_scale=adapted and _scale(**adapted),
        made=str(stored["made"]),
        made_of=str(stored["made_of"]),
    )


@lru_cache
def prior(kind: str) -> Model:
    """Return the shipped model of a kind of evidence (see `runtime.recognise.evidence`). Raises ModelError where the
    file is missing or damaged."""
    path = shipped("models") / f"confidence_{kind}.json"
    try:
        return from_json(read_file(path, _MAX_FILE_BYTES).decode())
    except (OSError, ValueError) as error:
        raise ModelError(f"{path} cannot be used ({error}): install edgevpr again.") from error


def _logistic(names: list[str], weights: list[float], scales: list[float], bias: float) -> Logistic:
    return Logistic(tuple(map(str, names)), tuple(weights), tuple(scales), bias)


def _scale(off_map: dict[str, float], off_place: dict[str, float], slope: float, offset: float) -> Scale:
    return Scale(Tail(**off_map), Tail(**off_place), slope, offset)
