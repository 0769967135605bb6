"""The shipped model of confidence, fitted to the matches of many sites."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import date

import numpy as np

from edgevpr.calibrate.calibrate import Answer, adapted
from edgevpr.calibrate.fit import fitted, matrix, nothing_known, tail_of
from edgevpr.confidence.model import Evidence, Logistic, Model, Tail
from edgevpr.runtime.recognise.evidence import OF_MAP, OF_PLACE

_PULL = 0.3
_EACH = 100.0  # the weight of the right, and of the wrong, matches of a map


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """What a map says of its site: the evidence of real queries, and the `answers` to changed pictures of its own.
    `own` are queries of the site with whether their match is right, `foreign` queries of other sites."""

    name: str
    own: Sequence[tuple[Evidence, bool]]
    foreign: Sequence[Evidence]
    answers: Sequence[Answer]


def shipped_model(kind: str, sites: Sequence[Site], made_of: str) -> Model:
    """Fit the model of one kind of evidence to these sites, each as important as any other."""
    of_map = _regression(
        OF_MAP[kind],
        [
            ([evidence for evidence, right in site.own if right], True)
            for site in sites
        ]
        + [(site.foreign, False) for site in sites],
    )
    of_place = _regression(
        OF_PLACE[kind],
        [([evidence for evidence, each in site.own if each == right], right) for site in sites for right in (True, False)]
        + [
            ([answer.evidence for answer in site.answers if answer.right == right], right)
            for site in sites
            for right in (True, False)
        ],
    )
    model = Model(
        of_map=of_map,
        of_place=of_place,
        slope=1.0,
        offset=0.0,
        tail=Tail(0.0, 0.0, 1.0),
        made=date.today().isoformat(),
        made_of=made_of,
    )
    return _made_probable(model, sites)


def of_map_alone(model: Model, site: Site) -> Model:
    """Return the model that the map of a site would carry: adapted to its own answers, where it has any."""
    return adapted(model, site.answers, site.name) if site.answers else model


def _regression(names: Sequence[str], groups: Iterable[tuple[Sequence[Evidence], bool]]) -> Logistic:
    groups = [(rows, right) for rows, right in groups if len(rows)]
    rows = [row for group, _ in groups for row in group]
    right = np.concatenate([np.full(len(group), each) for group, each in groups])
    weights = np.concatenate([np.full(len(group), _EACH / len(group)) for group, _ in groups])
    scales = np.maximum(matrix(rows, names).std(0), 1e-3)
    return fitted(nothing_known(names, scales), rows, right, weights, _PULL * len(groups))


def _made_probable(model: Model, sites: Sequence[Site]) -> Model:
    """Return a model whose confidence is a probability, and that knows how many wrong matches are left beyond a logit:
    as if the aircraft flew over ground of the map half of the time."""
    logits, right, weights = [], [], []
    for site in sites:
        own = of_map_alone(model, site)
        for group, is_own in ((site.own, True), ([(each, False) for each in site.foreign], False)):
            if len(group):
                logits += [own.logit(evidence) for evidence, _ in group]
                right += [each for _, each in group]
                weights += [_EACH / len(group)] * len(group)
    logits, right, weights = np.array(logits), np.array(right), np.array(weights)
    start = Logistic(("logit",), (1.0,), (1.0,), 0.0)
    line = fitted(start, [{"logit": each} for each in logits], right, weights, _PULL)
    tail = tail_of(logits[~right], weights[~right] / weights.sum())
    return replace(model, slope=line.weights[0], offset=line.bias, tail=tail)
