"""The confidence model: converts the evidence for a match (see `evidence`) to the probability that it is correct.

A match can be wrong in two ways: the query shows ground outside the map, or the best place is not the correct one.
Chance agreement is much the same in every map, but maps differ in how much their places look alike. So each error has
its logistic regression. Both come with edgevpr, and are adapted to a map that is large enough (see `calibrate`).

The distribution of the logits of wrong matches was measured on many sites: the highest follow an exponential
distribution (peaks over threshold: Pickands 1975). The *chance* of a match is the probability that a wrong match has
logits at least as high, summed over both errors. For a precision p, matches with a chance of at most 1 - p are
accepted. The confidence is a logistic function of the logarithm of the chance (Platt 1999)."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from edgevpr.core.errors import ModelError
from edgevpr.core.files import find_shipped, read_file

Figures = Mapping[str, float]  # figures of the evidence for a match, by name

_MAX_FILE_BYTES = 100_000
_MAX_LOGIT = 40.0  # beyond it, a probability is 0 or 1 in float64
# Safety factors on the permitted fraction of wrong matches, because a chance is an estimate. Without them one tunnel of
# nordland_tiny was mistaken for another, and a foreign picture for a place of aerial_swindale; with a model that is not
# adapted to its map, also foreign pictures for the five places of grief_michigan_monthly.
_ADAPTED_FACTOR = 0.5
_DEFAULT_FACTOR = 0.1
_MIN_CHANCE = 1e-15  # so that the logarithm exists
# A chance is multiplied by this power of the fraction of rotations tried. It would be 1 if they were independent, but
# streets and furrows have directions. Of 2,015 foreign and mirrored pictures, queried with random headings in the maps
# of sat_marash and aerial_garfield28, 3 had a chance below 1 % without this factor, and 12 one below 30 %.
_ROTATIONS_EXPONENT = 2 / 3


@dataclass(frozen=True, slots=True)
class Logistic:
    """A logistic regression on the evidence for a match. Its logit is `bias` plus the sum of the figures in `names`,
    each times its weight in `weights`. `scales` are the standard deviations of these figures over many sites, used to
    adapt the regression to a map."""

    names: tuple[str, ...]
    weights: tuple[float, ...]
    scales: tuple[float, ...]
    bias: float

    def logit(self, evidence: Figures) -> float:
        """Return the logit of a match with this evidence."""
        return self.bias + sum(w * evidence[name] for w, name in zip(self.weights, self.names, strict=True))


@dataclass(frozen=True, slots=True)
class Tail:
    """Distribution of the highest logits of wrong matches. The fraction of all matches that are wrong and have a logit
    above `start` is `share`; above `start` + n * `scale` it is `share` times exp(-n)."""

    start: float
    share: float
    scale: float

    def compute_exceedance(self, logit: float) -> float:
        """Return the fraction of all matches that are wrong and have a logit above this one; at most 1."""
        return math.exp(min(0.0, math.log(self.share) + (self.start - logit) / self.scale))


@dataclass(frozen=True, slots=True)
class Scale:
    """Conversion of the logits of a model to a confidence. `off_map` and `off_place` are the tails of the matches that
    are wrong because the query is off the map, or at another place. The logit of the confidence is linear in
    -log(chance), with `slope` and `offset`."""

    off_map: Tail
    off_place: Tail
    slope: float
    offset: float

    def confidence(self, chance: float) -> float:
        """Return the probability that a match is correct, given its chance (see the module docstring)."""
        logit = self.offset - self.slope * math.log(max(chance, _MIN_CHANCE))
        return 1 / (1 + math.exp(-max(-_MAX_LOGIT, min(_MAX_LOGIT, logit))))


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """Computes the confidence of the matches of one technique and kind of evidence. `of_map` is the regression on
    whether the query shows ground of the map, `of_place` on whether the best place is the correct one, and `scale`
    converts their logits. `adapted_scale` replaces `scale` once the model is adapted to a map (None: this model is
    adapted). `made` is its date, `made_of` describes the data it was fitted to in words, and `matches` is the number of
    matches from many sites that the scale was fitted to."""

    of_map: Logistic
    of_place: Logistic
    scale: Scale
    adapted_scale: Scale | None = None
    made: str
    made_of: str
    matches: int

    def chance(self, evidence: Figures) -> float:
        """Return the probability that a wrong match has at least this evidence; 1 if a figure is not finite. If the
        heading is known, fewer rotations are tried than in calibration, and `tried` lowers the chance accordingly."""
        of_map, of_place = self.of_map.logit(evidence), self.of_place.logit(evidence)
        if not (math.isfinite(of_map) and math.isfinite(of_place)):
            return 1.0
        chance = self.scale.off_map.compute_exceedance(of_map) + self.scale.off_place.compute_exceedance(of_place)
        return min(1.0, chance * math.pow(evidence.get("tried", 1.0), _ROTATIONS_EXPONENT))

    def confidence(self, evidence: Figures) -> float:
        """Return the probability that the match is correct, 0..1."""
        return self.scale.confidence(self.chance(evidence))

    @property
    def max_reported(self) -> float:
        """Return the highest confidence that the data support: if none of n matches was wrong, 1 - 1/n."""
        return 1 - 1 / max(self.matches, 1)

    def map_confidence(self, evidence: Figures) -> float:
        """Return the probability, 0..1, that the query shows ground of the map, no matter which place."""
        logit = self.of_map.logit(evidence)
        return self.scale.confidence(self.scale.off_map.compute_exceedance(logit) if math.isfinite(logit) else 1.0)

    def threshold(self, precision: float) -> float:
        """Return the lowest confidence for which the fraction `precision` (below 1) of the matches is correct. A model
        that is not adapted to its map does not reflect how similar its places look, so its threshold is higher."""
        max_wrong = 1 - precision
        return self.scale.confidence(max_wrong * (_ADAPTED_FACTOR if self.adapted_scale is None else _DEFAULT_FACTOR))


def parse_model(fields: Mapping[str, Any]) -> Model:
    """Make a model from decoded JSON. Raises KeyError or TypeError for invalid contents."""
    scales = {name: fields[name] and _make_scale(**fields[name]) for name in ("scale", "adapted_scale")}
    regressions = {name: _make_logistic(**fields[name]) for name in ("of_map", "of_place")}
    return Model(**{**fields, **regressions, **scales})


@lru_cache
def read_default_model(kind: str) -> Model:
    """Return the default model for a kind of evidence (see `evidence`). Raises ModelError if its file is unusable."""
    path = find_shipped("models") / f"confidence_{kind}.json"
    try:
        return parse_model(json.loads(read_file(path, _MAX_FILE_BYTES)))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ModelError(f"{path} is unusable ({error}): reinstall edgevpr.") from error


def _make_logistic(names: list[str], weights: list[float], scales: list[float], bias: float) -> Logistic:
    return Logistic(tuple(names), tuple(weights), tuple(scales), bias)


def _make_scale(off_map: dict[str, float], off_place: dict[str, float], slope: float, offset: float) -> Scale:
    return Scale(Tail(**off_map), Tail(**off_place), slope, offset)
