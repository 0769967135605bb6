"""Fit the shipped model of match confidence to the matches of many sites (see benchmarks/confidence.py)."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import date

import numpy as np

from edgevpr.mapmaking.calibrate import QueryResult, adapt_model, fit_logistic, make_evidence_matrix
from edgevpr.runtime.recognise.confidence import Logistic, Model, Scale, Tail
from edgevpr.runtime.recognise.evidence import MAP_FIGURES, PLACE_FIGURES, Evidence

_PRIOR_WEIGHT = 0.3
# Fractions of the wrong matches that form a tail. With 0.3 for _OFF_PLACE_TAIL, it depended on the random choice of the
# pictures that adapt a map whether one tunnel of nordland_tiny was taken for another.
_OFF_MAP_TAIL = 0.02
_OFF_PLACE_TAIL = 0.4
_STAND_IN_TAIL = 0.2
_MIN_WRONG_MATCHES = 20
_MAP_WEIGHT = 100.0  # of all right matches of a map, and of all wrong ones
_MIN_TAIL_MATCHES = 5
_MIN_SCALE = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteEvidence:
    """Evidence of queries in the map of one site: `own` of queries of the site, each with whether its match is right,
    `foreign` of queries of other sites, and `answers` to altered versions of the site's own pictures."""

    name: str
    own: Sequence[tuple[Evidence, bool]]
    foreign: Sequence[Evidence]
    answers: Sequence[QueryResult]


def fit_shipped_model(kind: str, sites: Sequence[SiteEvidence], made_of: str) -> Model:
    """Fit the model of one kind of evidence to these sites, with equal weight for each site."""
    of_map = _fit_regression(
        MAP_FIGURES[kind],
        [([evidence for evidence, right in site.own if right], True) for site in sites]
        + [(site.foreign, False) for site in sites],
    )
    matches = [site.own for site in sites]
    matches += [[(answer.evidence, answer.right) for answer in site.answers] for site in sites]
    of_place = _fit_regression(
        PLACE_FIGURES[kind],
        [
            ([row for row, is_right in group if is_right == right], right)
            for group in matches
            for right in (True, False)
        ],
    )
    unfitted = Scale(Tail(0.0, 1.0, 1.0), Tail(0.0, 1.0, 1.0), 1.0, 0.0)
    today = date.today().isoformat()
    count = sum(len(site.own) + len(site.foreign) for site in sites)
    model = Model(of_map=of_map, of_place=of_place, scale=unfitted, made=today, made_of=made_of, matches=count)
    unadapted = [(site, model) for site in sites]
    adapted = [(site, adapt_model(model, kind, site.answers, site.name)) for site in sites if site.answers]
    return replace(model, scale=_fit_scale(unadapted), adapted_scale=_fit_scale(adapted) if adapted else None)


def _fit_regression(names: Sequence[str], groups: Iterable[tuple[Sequence[Evidence], bool]]) -> Logistic:
    """Fit a logistic regression on the named figures of evidence, with equal weight for each group (right or wrong)."""
    groups = [(rows, right) for rows, right in groups if len(rows)]
    rows = [row.figures() for group, _ in groups for row in group]
    right = np.concatenate([np.full(len(group), is_right) for group, is_right in groups])
    weights = np.concatenate([np.full(len(group), _MAP_WEIGHT / len(group)) for group, _ in groups])
    scales = np.maximum(make_evidence_matrix(rows, names).std(0), 1e-3)
    prior = Logistic(tuple(names), (0.0,) * len(names), tuple(scales.tolist()), 0.0)
    return fit_logistic(prior, rows, right, weights, _PRIOR_WEIGHT * len(groups))


def _fit_scale(sites: Sequence[tuple[SiteEvidence, Model]]) -> Scale:
    """Fit the scale that turns logits into probabilities: the tails of matches off the map and at wrong places, then a
    line through both. Matches without a lead are never accepted, so the tail of wrong places omits them."""
    foreign = [(model, evidence) for site, model in sites for evidence in site.foreign]
    own = [(model, evidence, right) for site, model in sites for evidence, right in site.own]
    wrong = [(model, evidence) for model, evidence, right in own if not right and evidence.is_unambiguous]
    count, fraction = len(own), _OFF_PLACE_TAIL
    if len(wrong) < _MIN_WRONG_MATCHES:  # too few: queries of other sites stand in for them
        wrong = [(model, evidence) for model, evidence in foreign if evidence.is_unambiguous]
        count, fraction = len(foreign), _STAND_IN_TAIL
    logits = [model.of_map.logit(evidence.figures()) for model, evidence in foreign]
    off_map = _fit_tail(logits, len(foreign), _OFF_MAP_TAIL)
    off_place = _fit_tail([model.of_place.logit(evidence.figures()) for model, evidence in wrong], count, fraction)
    scale = Scale(off_map, off_place, 1.0, 0.0)
    rows, right, weights = [], [], []
    for site, model in sites:
        model = replace(model, scale=scale)
        for group in (site.own, [(evidence, False) for evidence in site.foreign]):
            rows += [{"log_chance": -math.log(max(model.chance(evidence.figures()), 1e-15))} for evidence, _ in group]
            right += [is_right for _, is_right in group]
            weights += [_MAP_WEIGHT / len(group)] * len(group)
    prior = Logistic(("log_chance",), (1.0,), (1.0,), 0.0)
    line = fit_logistic(prior, rows, np.array(right), np.array(weights), _PRIOR_WEIGHT)
    return replace(scale, slope=line.weights[0], offset=line.bias)


def _fit_tail(wrong: Sequence[float], count: int, fraction: float) -> Tail:
    """Fit the tail to the highest `fraction` of the logits of `wrong` matches; `count` is the number of all matches."""
    highest = np.sort(wrong)[::-1][: max(_MIN_TAIL_MATCHES, math.ceil(fraction * len(wrong))) + 1]
    start, tail = float(highest[-1]), highest[:-1]
    return Tail(start, len(tail) / count, max(float((tail - start).mean()), _MIN_SCALE))
