"""The model of confidence: evidence of a match in, the probability that the match is right out.

A match is right when two things hold: the query shows ground of the map at all, and the best place is the right one of
it. The first is much the same for every map, since it is how well any two pictures agree by chance. The second is not:
every map has its own look-alikes. So there is one logistic regression for each, and the product of their probabilities.
The second is fitted anew for each map that is large enough (see `calibrate`), and starts from the shipped one.

The threshold that a precision asks for comes from the wrong matches of many sites: above a start their logits fall off
as an exponential distribution does (peaks over a threshold: Pickands 1975), which says how many are left beyond any.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

from edgevpr.errors import ModelError
from edgevpr.helpers.files import read_file
from edgevpr.resources import shipped

Evidence = Mapping[str, float]

_MAX_FILE_BYTES = 100_000
_MOST = 40.0  # of a logit: beyond, a probability is 0 or 1 in float64


@dataclass(frozen=True, slots=True)
class Logistic:
    """A logistic regression: the logit is `bias` plus the sum of `weights` times evidence, by their `names`. `scales`
    are the standard deviations of that evidence, over many sites."""

    names: tuple[str, ...]
    weights: tuple[float, ...]
    scales: tuple[float, ...]
    bias: float

    def logit(self, evidence: Evidence) -> float:
        return self.bias + sum(w * evidence[name] for w, name in zip(self.weights, self.names, strict=True))


@dataclass(frozen=True, slots=True)
class Tail:
    """Wrong matches of many sites, as a share of all: so many as `share` are beyond the logit `start`, and fewer by the
    factor e with every `scale` more."""

    start: float
    share: float
    scale: float

    def beyond(self, wrong: float) -> float:
        """Return the logit beyond which no more than the share `wrong` is left."""
        return self.start + self.scale * max(0.0, math.log(self.share / wrong))


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """Confidence of the matches of one technique and kind of evidence. `of_map` tells whether the query shows ground of
    the map, `of_place` whether the best place is the right one of it. `slope` and `offset` make a probability of both
    together (Platt 1999). `made` is the date, and `made_of` what it was fitted to, in words."""

    of_map: Logistic
    of_place: Logistic
    slope: float
    offset: float
    tail: Tail
    made: str
    made_of: str

    def logit(self, evidence: Evidence) -> float:
        """Return the logit of both together. Evidence that is not finite gives the lowest."""
        parts = self.of_map.logit(evidence), self.of_place.logit(evidence)
        if not all(map(math.isfinite, parts)):
            return -_MOST
        # Of the product p = 1 / ((1 + e^-a) (1 + e^-b)): the odds against it are e^-a + e^-b + e^-(a+b).
        against = sum(math.exp(min(-each, 2 * _MOST)) for each in (*parts, sum(parts)))
        return max(-_MOST, min(_MOST, -math.log(against)))

    def confidence(self, evidence: Evidence) -> float:
        """Return the probability that the match is right, 0..1."""
        return probability(self.slope * self.logit(evidence) + self.offset)

    def threshold(self, precision: float) -> float:
        """Return the confidence from which on `precision` (below 1) of the matches are right."""
        return probability(self.slope * self.tail.beyond(1 - precision) + self.offset)


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


def model_of(found: Mapping[str, Any]) -> Model:
    """Make a model of what JSON holds. Raises ValueError, KeyError or TypeError where that makes no sense."""
    return Model(
        of_map=_logistic(found["of_map"]),
        of_place=_logistic(found["of_place"]),
        slope=_number(found["slope"]),
        offset=_number(found["offset"]),
        tail=Tail(**{key: _number(found["tail"][key]) for key in ("start", "share", "scale")}),
        made=str(found["made"]),
        made_of=str(found["made_of"]),
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


def _logistic(found: dict[str, Any]) -> Logistic:
    names = tuple(str(name) for name in found["names"])
    weights, scales = (tuple(_number(each) for each in found[key]) for key in ("weights", "scales"))
    if not len(names) == len(weights) == len(scales):
        raise ValueError("as many names as weights and scales are needed")
    return Logistic(names, weights, scales, _number(found["bias"]))


def _number(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{value!r:.80} is no number")
    return number
