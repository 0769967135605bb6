"""Trials of techniques, each in a child process: the memory that one has loaded is not counted for another, and a
library that crashes on this processor fails only its own trial.

`python -m edgevpr.runtime.preflight.trial` is that child process: it reads a job as JSON and prints a Trial as JSON.
"""

import signal
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from edgevpr import techniques
from edgevpr.core.child import Ended, ask_child, last_line, serve_parent
from edgevpr.core.config import FORMS
from edgevpr.core.errors import EdgevprError
from edgevpr.core.types import StageCost
from edgevpr.frames.images import read_image
from edgevpr.runtime.preflight.probe import TechniqueCosts, noise, probe
from edgevpr.runtime.recognise.opening import made_with
from edgevpr.techniques.card import load_card, weights_of

_TRIED_S = 1.0  # pictures are tried again for so long; the check before a flight has no time for that
_LIMIT_S = 900.0  # ten times what the slowest technique takes on the slowest board


@dataclass(frozen=True, slots=True)
class Offer:
    """A technique to try, with its settings, one of which may be its form. `label` tells it from other offers."""

    label: str
    name: str
    settings: dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """Result of trying an offer: its `costs`, or the `problem`, a sentence that says why it cannot be used here.

    `settings`: those of the offer. `parameters`: all that the technique then had. `model`: fingerprint of its network.
    `weights`: name of the network's weights (both None: no network).
    """

    label: str
    name: str
    settings: dict[str, Any]
    costs: TechniqueCosts | None = None
    problem: str | None = None
    model: str | None = None
    weights: str | None = None
    parameters: dict[str, Any] = field(default_factory=dict)


def offers(
    names: Iterable[str], forms: Iterable[str] = FORMS, settings: Mapping[str, Mapping[str, Any]] | None = None
) -> tuple[Offer, ...]:
    """Return an offer for each technique in each of `forms`; one only if it has no forms or its `settings` name one.

    `settings` are by technique name. Raises UsageError for an unknown name, ModelError for a card that is incomplete.
    """
    listed = []
    for name in names:
        own = dict((settings or {}).get(name, {}))
        if "form" in own or "form" not in techniques.parameters(name):
            listed.append(Offer(techniques.labelled(name, own.get("form")), name, own))
        else:
            listed += [Offer(techniques.labelled(name, form), name, {**own, "form": form}) for form in forms]
    return tuple(listed)


def try_each(wanted: Iterable[Offer], threads: int, images: Sequence[Path] = (), rounds: int = 0) -> Iterator[Trial]:
    """Try each offer in a child process, and yield the results. An unusable technique has one result, under its name.

    The pictures are `images`; without them `rounds` pictures of noise are made (0: a quick trial). `threads` are those
    of a network.
    """
    refused = set()
    for offer in wanted:
        if offer.name in refused:
            continue
        try:
            model_of(offer.name, offer.settings)  # raises if the card already shows that it cannot be used
            trial = _in_a_process(offer, threads, images, rounds)
        except EdgevprError as error:
            trial = _refused(offer, str(error))
        if trial.problem:
            refused.add(offer.name)
        yield trial


def model_of(name: str, settings: dict[str, Any]) -> str | None:
    """Return the fingerprint of the network that a technique would use now; None if it uses none. Raises ModelError."""
    parameters = techniques.parameters(name)
    if "threads" not in parameters:  # every network has this parameter, and nothing else has
        return None
    return load_card(settings.get("model") or parameters.get("model", name)).fingerprint


def trial_of(fields: dict[str, Any]) -> Trial:
    """Make a Trial from the output of `asdict`. Raises TypeError, KeyError or ValueError for anything else."""
    costs = fields["costs"]
    if costs is not None:
        stages = ("encode", "match_per_place", "scan_per_place", "scan_once", "compare_once")
        costs = TechniqueCosts(**{**costs, **{stage: StageCost(**costs[stage]) for stage in stages}})
    return Trial(**{**fields, "costs": costs})


def _in_a_process(offer: Offer, threads: int, images: Sequence[Path], rounds: int) -> Trial:
    job = {**asdict(offer), "threads": threads, "images": [str(path) for path in images], "rounds": rounds}
    ended = ask_child("edgevpr.runtime.preflight.trial", job, _LIMIT_S)
    return trial_of(ended.answer) if ended.code == 0 else _refused(offer, _why_it_ended(offer.label, ended))


def _refused(offer: Offer, problem: str) -> Trial:
    return Trial(label=offer.name, name=offer.name, settings=offer.settings, problem=problem)


def _why_it_ended(label: str, ended: Ended) -> str:
    if ended.code is None:
        return f"Trying {label} took longer than {_LIMIT_S / 60:.0f} minutes: it is too slow for this machine."
    if ended.code >= 0:
        return f"Trying {label} failed ({last_line(ended)}): install edgevpr and its packages again."
    hint = "a library does not suit this processor: install another"
    if ended.code == -signal.SIGKILL:
        hint = "memory ran out"
    return f"Trying {label} was ended by {signal.Signals(-ended.code).name}: {hint}."


def _try_here(job: dict[str, Any]) -> Trial:
    offer = Offer(job["label"], job["name"], job["settings"])
    try:
        pictures = [read_image(path) for path in job["images"]] or (noise(job["rounds"]) if job["rounds"] else None)
        technique = made_with(job["threads"], offer.name, offer.settings)
        costs = probe(technique, pictures, tried_s=_TRIED_S)
        model = model_of(offer.name, offer.settings)
    except EdgevprError as error:
        return _refused(offer, str(error))
    spec = technique.spec
    return Trial(**asdict(offer), costs=costs, model=model, weights=weights_of(spec), parameters=spec.parameters)


if __name__ == "__main__":
    serve_parent(lambda job: asdict(_try_here(job)))
