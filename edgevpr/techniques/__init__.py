"""The techniques, by name. Nothing of a technique is imported before it is asked for."""

import difflib
import importlib
import inspect
from dataclasses import dataclass
from functools import partial
from typing import Any

from edgevpr.contract import Technique
from edgevpr.errors import EdgevprError, UsageError


@dataclass(frozen=True, slots=True)
class _Own:
    """Where the class of a technique is, and which output of its `model` it uses (None: it has no model)."""

    where: str
    network_output: str | None = None


# The first are what a board is offered by itself, best first: see AUTOMATIC.
_REGISTRY = {
    "cohog": _Own("edgevpr.techniques.cohog:CoHog"),
    "hog": _Own("edgevpr.techniques.hog:Hog"),
    "seqslam": _Own("edgevpr.techniques.seqslam:SeqSlam"),
    "calc": _Own("edgevpr.techniques.calc:Calc", "descriptor"),
    "alexnet": _Own("edgevpr.techniques.alexnet:AlexNet", "features"),
    "amosnet": _Own("edgevpr.techniques.amosnet:AmosNet", "features"),
    "hybridnet": _Own("edgevpr.techniques.hybridnet:HybridNet", "features"),
    "netvlad": _Own("edgevpr.techniques.netvlad:NetVlad", "features"),
    "rmac": _Own("edgevpr.techniques.rmac:RMac", "features"),
    "region_vlad": _Own("edgevpr.techniques.region_vlad:RegionVlad", "features"),
    "cross_region_bow": _Own("edgevpr.techniques.cross_region_bow:CrossRegionBow", "features"),
}
# Where several fit a board, the first is taken. Networks are used when they are asked for: they want onnxruntime in
# RAM, and weights that somebody has chosen. A sequence wants a flight along the way that was mapped.
AUTOMATIC = ("cohog", "hog")


def names() -> tuple[str, ...]:
    """Names of all techniques: those of edgevpr, then the networks whose cards make a descriptor by themselves.

    A card that cannot be read is left out here, and says what is wrong with it when it is asked for by name.
    """
    return (*_REGISTRY, *(name for name in _cards() if not is_own(name)))


def is_own(name: str) -> bool:
    """Whether edgevpr itself has a technique of this name: a card that is called the same is only its `model`."""
    return name in _REGISTRY


def is_known(name: str) -> bool:
    """Whether there is a technique, or the card of a network, of this name."""
    from edgevpr.techniques.networks.card import card_names

    return name in _REGISTRY or name in card_names()


def parameters(name: str) -> dict[str, Any]:
    """The parameters of the technique `name` and their defaults. Raises UsageError for an unknown technique."""
    return {key: p.default for key, p in inspect.signature(_class(name)).parameters.items()}


def labelled(name: str, form: str | None) -> str:
    """A technique and its form as one name; that of `float` (None: it has no forms) is left out."""
    return name if form in (None, "float") else f"{name} {form}"


def network_output(name: str) -> str | None:
    """Which output of its `model`, "features" or "descriptor", the technique `name` uses; None: it has no model."""
    return _REGISTRY[name].network_output if is_own(name) else None


def create(name: str, settings: dict[str, Any] | None = None) -> Technique:
    """Make the technique `name` with `settings` (texts are read as the parameter's type; the rest is default).

    Raises UsageError for an unknown technique or parameter, a value that cannot be read, or one out of range, and
    ModelError for a network that cannot be used.
    """
    defaults = parameters(name)
    values = {}
    for key, value in (settings or {}).items():
        if key not in defaults:
            near = difflib.get_close_matches(key, defaults, n=1)
            hint = f"did you mean `{near[0]}`?" if near else f"it has {', '.join(defaults)}."
            raise UsageError(f"{name} has no parameter `{key}`: {hint}")
        kind = type(defaults[key])
        try:
            values[key] = kind(value)
        except ValueError:
            raise UsageError(f"{name}: `{key}` is {value!r}; it must be {_words[kind]}.") from None
    return _class(name)(**values)


def _class(name: str) -> Any:
    if name in _REGISTRY:
        module, _, class_name = _REGISTRY[name].where.partition(":")
        return getattr(importlib.import_module(module), class_name)
    if not is_known(name):
        raise UsageError(f"There is no technique `{name}`: use one of {', '.join(names())}.")
    from edgevpr.techniques.networks.card import load_card

    card = load_card(name)
    if not card.is_technique:
        raise UsageError(
            f"The network `{name}` gives feature maps only: use it as the `model` of a technique, or name a head on "
            "its card."
        )
    from edgevpr.techniques.network import CardNetwork

    return partial(CardNetwork, card)


def _cards() -> list[str]:
    from edgevpr.techniques.networks.card import card_names, load_card

    found = []
    for name in card_names():
        try:
            if load_card(name).is_technique:
                found.append(name)
        except EdgevprError:
            continue
    return found


_words = {int: "a whole number", float: "a number", str: "a word"}
