"""Trials of techniques, each in a child process with all its forms: the memory that one has loaded is not counted for
another, and a library that crashes on this processor fails only its own trials.

`python -m edgevpr.runtime.preflight.trial` is that child process: it reads a job as JSON and prints Trials as JSON.
"""

import ctypes
import gc
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from typing import Any

from edgevpr import techniques
from edgevpr.core.child import ask_child, serve_parent
from edgevpr.core.config import FORMS, build
from edgevpr.core.errors import EdgevprError
from edgevpr.runtime.preflight.probe import TechniqueCosts, probe
from edgevpr.runtime.recognise.opening import made_for
from edgevpr.techniques.card import find_weights

_TRIED_S = 0.5  # pictures are tried again for so long; twice as long finds the same. A check has no time for that
_LIMIT_S = 900.0  # ten times what the slowest technique takes on the slowest board


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A technique to try (an offer), or that was tried, with its settings, one of which may be its form. `label` is its
    unique name.

    Once it was tried, it has its `costs`, or the `problem`, a sentence that says why it cannot be used here.
    `parameters`: all parameters of the technique when it was tried. `weights`: name of its network's weights (None: no
    network).
    """

    label: str
    name: str
    settings: dict[str, Any]
    costs: TechniqueCosts | None = None
    problem: str | None = None
    weights: str | None = None
    parameters: dict[str, Any] = field(default_factory=dict)


def offers(
    names: Iterable[str], forms: Iterable[str] = FORMS, settings: Mapping[str, Mapping[str, Any]] | None = None
) -> tuple[Trial, ...]:
    """Return the trials to make, not yet made: one for each technique of `names` in each of `forms`, or only one if it
    has no forms or its settings name one. `settings` are by technique name. Raises UsageError for an unknown name,
    ModelError for a card that is incomplete."""
    trials = []
    for name in names:
        own = dict((settings or {}).get(name, {}))
        is_one = "form" in own or "form" not in techniques.parameters(name)
        for chosen in (own,) if is_one else ({**own, "form": form} for form in forms):
            trials.append(Trial(label=techniques.labelled(name, chosen.get("form")), name=name, settings=chosen))
    return tuple(trials)


def try_each(wanted: Sequence[Trial], threads: int) -> Iterator[Trial]:
    """Make the `wanted` trials, those of a technique in one child process, and yield each with its result. A technique
    that cannot be used has one result, labelled with its name. `threads`: number of threads for networks."""
    for name, forms in groupby(wanted, lambda trial: trial.name):
        trials = list(forms)
        job = {"threads": threads, "trials": [asdict(trial) for trial in trials]}
        try:
            answer = ask_child("edgevpr.runtime.preflight.trial", job, _LIMIT_S, f"Trying {name}")
        except EdgevprError as error:
            yield replace(trials[0], label=name, problem=str(error))
        else:
            yield from (build(Trial, tried, "a trial") for tried in answer)


def _try_here(job: dict[str, Any]) -> list[dict[str, Any]]:
    tried = []
    for content in job["trials"]:
        offer = build(Trial, content, "a trial")
        technique = made_for(job["threads"], offer.name, offer.settings)
        costs = probe(technique, tried_s=_TRIED_S)
        spec = technique.spec
        tried.append(asdict(replace(offer, costs=costs, weights=find_weights(spec), parameters=spec.parameters)))
        # What a form has taken is given back, or it would be counted for the next one.
        del technique
        gc.collect()
        if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # musl has none
            trim(0)
    return tried


if __name__ == "__main__":
    serve_parent(_try_here)
