"""The techniques, by name. The module of a technique is imported only when the technique is asked for."""

import importlib
import inspect
from dataclasses import dataclass
from functools import partial
from typing import Any

from edgevpr.core.contract import Technique
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.text import meant


@dataclass(frozen=True, slots=True)
class _Own:
    """A technique of edgevpr itself: the location of its class (`where`), and the output of its `model` that it uses
    (None: it has no model)."""

    where: str
    network_output: str | None = None


# The first ones are offered to a board automatically, best first: see AUTOMATIC.
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
# If several fit a board, the first is taken. Networks must be asked for: they need onnxruntime in RAM, and weights that
# a person has chosen. So must `seqslam`: a sequence needs a flight along the mapped route.
AUTOMATIC = ("cohog", "hog")


def names() -> tuple[str, ...]:
    """Return the names of all techniques: those of edgevpr, then the networks whose cards make a descriptor by
    themselves.

    A card that cannot be read is left out here. Asking for it by name raises an error that says what is wrong.
    """
    return (*_REGISTRY, *(name for name in _cards() if not is_own(name)))


def is_own(name: str) -> bool:
    """Tell whether edgevpr itself has a technique of this name. A card of the same name is then only its `model`."""
    return name in _REGISTRY


def is_known(name: str) -> bool:
    """Tell whether there is a technique, or the card of a network, of this name."""
    from edgevpr.techniques.networks.card import card_names

    return name in _REGISTRY or name in card_names()


def parameters(name: str) -> dict[str, Any]:
    """Return the parameters of the technique `name` and their defaults. Raises UsageError for an unknown technique or a
    network that gives feature maps only, ModelError for a card that cannot be read."""
    return {key: p.default for key, p in inspect.signature(_class(name)).parameters.items()}


def labelled(name: str, form: str | None) -> str:
    """Return a technique and its form as one name. The form `float`, and None (the technique has no forms), are left
    out."""
    return name if form in (None, "float") else f"{name} {form}"


def network_output(name: str) -> str | None:
    """Return the output of its `model` that the technique `name` uses, "features" or "descriptor"; None: it has no
    model."""
    return _REGISTRY[name].network_output if is_own(name) else None


def create(name: str, settings: dict[str, Any] | None = None) -> Technique:
    """Make the technique `name` with `settings`. A text is converted to the type of its parameter; parameters that are
    not in `settings` keep their defaults.

    Raises UsageError for an unknown technique or parameter, a value that cannot be read, or one out of range, and
    ModelError for a network that cannot be used.
    """
    defaults = parameters(name)
    values = {}
    for key, value in (settings or {}).items():
        if key not in defaults:
            hint = meant(key, defaults, f"it has {', '.join(defaults)}.")
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
