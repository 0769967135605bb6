"""Trials of techniques. All forms of a technique run in the same child process, so that memory that one technique
has loaded is not counted for another, and a library that crashes on this processor fails only its own trials."""

import ctypes
import gc
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from itertools import groupby
from multiprocessing import get_context
from typing import Any

from edgevpr import techniques
from edgevpr.core.config import FORMS
from edgevpr.core.errors import EdgevprError
from edgevpr.runtime.preflight.probe import TechniqueCosts, measure_costs
from edgevpr.runtime.recognise.opening import make_technique
from edgevpr.techniques.card import describe_weights

_PR_SET_PDEATHSIG = 1  # prctl(2)
_REPEAT_S = 0.5  # per image; twice as long gives the same figures


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A trial of a technique in one form, pending or finished. `label`: unique name of the trial.

    A finished trial has `costs` or `problem`, a sentence that explains why this machine cannot run the technique.
    `parameters`: all parameters of the technique in the trial. `weights`: name of its network's weights (None: no
    network)."""

    label: str
    name: str
    settings: dict[str, Any]
    costs: TechniqueCosts | None = None
    problem: str | None = None
    weights: str | None = None
    parameters: dict[str, Any] = field(default_factory=dict)


def list_trials(settings: Mapping[str, Mapping[str, Any]], forms: Sequence[str] = FORMS) -> tuple[Trial, ...]:
    """Return the trials to run: one for each of the `forms` of each technique in `settings`, or one for a technique
    that has no forms or whose settings contain one. `settings`: by technique name. Raises UsageError for an unknown
    name, ModelError for an incomplete model card."""
    trials = []
    for name, fixed in settings.items():
        has_one_form = "form" in fixed or "form" not in techniques.read_parameters(name)
        for variant in (dict(fixed),) if has_one_form else ({**fixed, "form": form} for form in forms):
            trials.append(Trial(label=techniques.format_name(name, variant.get("form")), name=name, settings=variant))
    return tuple(trials)


def run_trials(trials: Sequence[Trial], threads: int) -> Iterator[Trial]:
    """Run `trials`, with one child process per technique, and yield each with its result. A technique that cannot be
    used yields a single result, labelled with its name. `threads`: number of threads for networks."""
    for name, forms in groupby(trials, lambda trial: trial.name):
        variants = list(forms)
        with ProcessPoolExecutor(1, get_context("spawn"), _begin_child, (os.getpid(),)) as pool:
            try:
                yield from pool.submit(_run_in_child, variants, threads).result()
            except EdgevprError as error:
                yield replace(variants[0], label=name, problem=str(error))
            except BrokenProcessPool:
                problem = f"The trial of {name} crashed: out of memory, or a library does not support this processor."
                yield replace(variants[0], label=name, problem=problem)


def _begin_child(parent_pid: int) -> None:
    """Make the kernel kill this process when its parent exits, even if a library is stuck in an endless loop. Exits
    at once if the parent has already exited."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:
        sys.exit(1)
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends this process without a second traceback
    os.dup2(2, 1)  # keep the output of libraries out of the program's standard output


def _run_in_child(trials: list[Trial], threads: int) -> list[Trial]:
    results = []
    for trial in trials:
        technique = make_technique(threads, trial.name, trial.settings)
        costs = measure_costs(technique, repeat_s=_REPEAT_S)
        spec = technique.spec
        results.append(replace(trial, costs=costs, weights=describe_weights(spec), parameters=spec.parameters))
        # Release the memory of this form; otherwise it would be counted for the next one.
        del technique
        gc.collect()
        if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # musl has none
            trim(0)
    return results
