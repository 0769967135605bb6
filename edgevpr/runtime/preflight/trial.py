"""Trials of techniques, each in a child process with all its forms: the memory that one has loaded is not counted for
another, and a library that crashes on this processor fails only its own trials."""

import ctypes
import gc
import os
import signal
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from itertools import groupby
from multiprocessing import get_context
from typing import Any

from edgevpr import techniques
from edgevpr.core.config import FORMS
from edgevpr.core.errors import EdgevprError
from edgevpr.runtime.preflight.probe import TechniqueCosts, probe
from edgevpr.runtime.recognise.opening import make_technique
from edgevpr.techniques.card import describe_weights

_PR_SET_PDEATHSIG = 1  # prctl(2)
_TRIED_S = 0.5  # pictures are tried again for so long; twice as long finds the same. A check has no time for that


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


def offers(names: Iterable[str], settings: Mapping[str, Mapping[str, Any]] | None = None) -> tuple[Trial, ...]:
    """Return the trials to make, not yet made: one for each technique of `names` in each of its forms, or only one if
    it has no forms or its settings name one. `settings` are by technique name. Raises UsageError for an unknown name,
    ModelError for a card that is incomplete."""
    trials = []
    for name in names:
        own = dict((settings or {}).get(name, {}))
        is_one = "form" in own or "form" not in techniques.read_parameters(name)
        for chosen in (own,) if is_one else ({**own, "form": form} for form in FORMS):
            trials.append(Trial(label=techniques.format_name(name, chosen.get("form")), name=name, settings=chosen))
    return tuple(trials)


def try_each(wanted: Sequence[Trial], threads: int) -> Iterator[Trial]:
    """Make the `wanted` trials, those of a technique in one child process, and yield each with its result. A technique
    that cannot be used has one result, labelled with its name. `threads`: number of threads for networks."""
    for name, forms in groupby(wanted, lambda trial: trial.name):
        trials = list(forms)
        with ProcessPoolExecutor(1, get_context("spawn"), _begin_child, (os.getpid(),)) as pool:
            try:
                yield from pool.submit(_try_here, trials, threads).result()
            except EdgevprError as error:
                yield replace(trials[0], label=name, problem=str(error))
            except BrokenProcessPool:
                why = f"Trying {name} ended its process: memory ran out, or a library does not suit this processor."
                yield replace(trials[0], label=name, problem=why)


def _begin_child(parent_pid: int) -> None:
    """Make the kernel kill this process when its parent ends in any way, even if a library here is in an endless loop.
    Exits at once if the parent has ended already."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:
        sys.exit(1)
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it without a traceback of its own
    os.dup2(2, 1)  # what a library prints does not go into the answer of the program


def _try_here(trials: list[Trial], threads: int) -> list[Trial]:
    tried = []
    for offer in trials:
        technique = make_technique(threads, offer.name, offer.settings)
        costs = probe(technique, tried_s=_TRIED_S)
        spec = technique.spec
        tried.append(replace(offer, costs=costs, weights=describe_weights(spec), parameters=spec.parameters))
        # What a form has taken is given back, or it would be counted for the next one.
        del technique
        gc.collect()
        if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # musl has none
            trim(0)
    return tried
