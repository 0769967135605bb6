"""The registry of the techniques of place recognition: their names, their parameters, and how to make one.

Map building, flights and evaluations make every technique here; its module is imported only then. "The thesis", in this
package, is Mubariz Zaffar, *Visual Place Recognition for Autonomous Robots*.
"""

import importlib
import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

from edgevpr.core.contract import Technique
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.text import meant

# Each technique of edgevpr itself: its module, the class or function there that makes it, and the output of its network
# that it uses (None: it has no network).
_OWN: dict[str, tuple[str, str, str | None]] = {
    "cohog": ("cohog", "CoHog", None),
    "hog": ("vectors", "Hog", None),
    "seqslam": ("seqslam", "SeqSlam", None),
    "calc": ("network", "calc", "descriptor"),
    "alexnet": ("network", "alexnet", "features"),
    "amosnet": ("network", "amosnet", "features"),
    "hybridnet": ("network", "hybridnet", "features"),
    "netvlad": ("network", "netvlad", "features"),
    "rmac": ("regions", "rmac", "features"),
    "region_vlad": ("network", "region_vlad", "features"),
    "cross_region_bow": ("regions", "cross_region_bow", "features"),
}
# Chosen without being asked for: the first that fits the board. Networks must be asked for: they need onnxruntime in
# RAM, and weights that a person has chosen. So must `seqslam`: a sequence needs a flight along the mapped route.
AUTOMATIC = ("cohog", "hog")
_WORDS = {int: "a whole number", float: "a number", str: "a word"}


def names() -> tuple[str, ...]:
    """Return the names of all techniques: those of edgevpr, then the networks whose cards make a vector by themselves.

    A card that cannot be read is left out. To `create` it by name raises an error that says what is wrong.
    """
    from edgevpr.techniques.card import card_names

    return (*_OWN, *(name for name in card_names() if not is_own(name) and _is_technique(name)))


def is_own(name: str) -> bool:
    """Tell whether `name` is one of edgevpr's own techniques. A card of that name then only supplies its weights."""
    return name in _OWN


def is_known(name: str) -> bool:
    """Tell whether `name` is a technique or the card of a network."""
    from edgevpr.techniques.card import card_names

    return name in _OWN or name in card_names()


def parameters(name: str) -> dict[str, Any]:
    """Return the parameters of the technique `name`, each with its default. Raises UsageError for an unknown technique
    or a network that gives feature maps only, ModelError for a card that cannot be read."""
    return {key: p.default for key, p in inspect.signature(_maker(name)).parameters.items()}


def labelled(name: str, form: str | None) -> str:
    """Return the technique and its `form` (see the glossary) as one name, such as "hog 8bit". The form is left out if
    it is `float`, the default, or None (the technique has no forms)."""
    return name if form in (None, "float") else f"{name} {form}"


def network_output(name: str) -> str | None:
    """Return the output of its network that the technique `name` uses, "features" or "descriptor". None for a technique
    of edgevpr without a network, and for one made from a card alone."""
    return _OWN[name][2] if is_own(name) else None


def create(name: str, settings: dict[str, Any] | None = None) -> Technique:
    """Make the technique `name`. `settings` are values of its parameters by name (None: all defaults); a text is
    converted to the type of its parameter. Parameters that are not in `settings` keep their defaults.

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
            raise UsageError(f"{name}: `{key}` is {value!r}; it must be {_WORDS[kind]}.") from None
    technique: Technique = _maker(name)(**values)
    return technique


def _maker(name: str) -> Callable[..., Any]:
    """Return the class or function that makes the technique `name`. The parameters in its signature are those of the
    technique. Raises as `parameters` does."""
    if is_own(name):
        module, maker, _ = _OWN[name]
        own: Callable[..., Any] = getattr(importlib.import_module(f"edgevpr.techniques.{module}"), maker)
        return own
    if not is_known(name):
        raise UsageError(f"There is no technique `{name}`: use one of {', '.join(names())}.")
    from edgevpr.techniques.card import load_card

    card = load_card(name)
    if not card.is_technique:
        raise UsageError(f"The network `{name}` gives no descriptor: use it as the `model` of a technique.")
    from edgevpr.techniques.network import of_card

    return partial(of_card, card)


def _is_technique(card: str) -> bool:
    from edgevpr.techniques.card import load_card

    try:
        return load_card(card).is_technique
    except EdgevprError:
        return False
