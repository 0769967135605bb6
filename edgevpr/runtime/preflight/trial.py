"""Trials of techniques, each in a child process: the memory that one has loaded is not counted for another, and a
library that crashes on this processor fails only its own trial.

`python -m edgevpr.runtime.preflight.trial` is that child process: it reads a job as JSON and prints a Trial as JSON.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

from edgevpr import techniques
from edgevpr.core.child import ask_child, serve_parent
from edgevpr.core.config import FORMS, build
from edgevpr.core.errors import EdgevprError
from edgevpr.power import machine
from edgevpr.runtime.preflight.probe import TechniqueCosts, probe
from edgevpr.runtime.recognise.opening import made_for
from edgevpr.techniques.card import weights_of

_TRIED_S = 0.5  # pictures are tried again for so long; twice as long finds the same. A check has no time for that
_TRIAL_MB = 1500.0  # of RAM for each that runs beside others; the largest networks take less
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
    listed = []
    for name in names:
        own = dict((settings or {}).get(name, {}))
        is_one = "form" in own or "form" not in techniques.parameters(name)
        for each in (own,) if is_one else ({**own, "form": form} for form in forms):
            listed.append(Trial(label=techniques.labelled(name, each.get("form")), name=name, settings=each))
    return tuple(listed)


def try_each(wanted: Sequence[Trial], threads: int) -> Iterator[Trial]:
    """Make each of the `wanted` trials in a child process, and yield it with its result. A technique that cannot be
    used has one result, labelled with its name. `threads`: number of threads for networks.

    Where cores and RAM allow, several are made at once, each with its own cores."""
    refused = set()
    at_once = max(1, min(int(machine.cores()) // threads, int(machine.ram_limit_mb() // _TRIAL_MB)))
    pool = ThreadPoolExecutor(at_once)
    try:
        for trial in pool.map(partial(_tried, threads), wanted):
            if trial.name not in refused:
                yield trial
            if trial.problem:
                refused.add(trial.name)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _tried(threads: int, offer: Trial) -> Trial:
    try:
        job = {"threads": threads, "trial": asdict(offer)}
        answer = ask_child("edgevpr.runtime.preflight.trial", job, _LIMIT_S, f"Trying {offer.label}")
        return build(Trial, answer, "a trial")
    except EdgevprError as error:
        return replace(offer, label=offer.name, problem=str(error))


def _try_here(job: dict[str, Any]) -> dict[str, Any]:
    offer = build(Trial, job["trial"], "a trial")
    technique = made_for(job["threads"], offer.name, offer.settings)
    spec = technique.spec
    costs = probe(technique, tried_s=_TRIED_S)
    return asdict(replace(offer, costs=costs, weights=weights_of(spec), parameters=spec.parameters))


if __name__ == "__main__":
    serve_parent(_try_here)
