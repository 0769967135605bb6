"""Registry of the place-recognition techniques: their names, their parameters, and a function that creates one.

Map building, flights and evaluations create every technique here, and its module is imported only then. "The thesis" is
Mubariz Zaffar, *Visual Place Recognition for Autonomous Robots*. A card is a YAML file that describes a network."""

import inspect
from collections.abc import Callable
from functools import partial
from pkgutil import resolve_name
from typing import Any

from edgevpr.core.contract import Technique
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.text import suggest
from edgevpr.techniques.card import list_cards, load_card

# The class or function that creates each built-in technique.
_FACTORIES = {
    "cohog": "cohog:CoHog",
    "hog": "vectors:Hog",
    "seqslam": "seqslam:SeqSlam",
    "calc": "network:calc",
    "alexnet": "network:alexnet",
    "amosnet": "network:amosnet",
    "hybridnet": "network:hybridnet",
    "netvlad": "network:netvlad",
    "rmac": "regions:rmac",
    "region_vlad": "network:region_vlad",
    "cross_region_bow": "regions:cross_region_bow",
}
CONFIDENCE_TECHNIQUE = "cohog"  # the only technique whose matches have a confidence
_TYPE_NAMES = {int: "an integer", float: "a number", str: "text"}


def list_techniques() -> tuple[str, ...]:
    """Return the names of all techniques: the built-in ones, then the networks whose cards have a descriptor.
    Unreadable cards are skipped. A card with the name of a built-in technique only supplies its weights."""

    def is_technique(card: str) -> bool:
        try:
            return load_card(card).is_technique
        except EdgevprError:
            return False

    return (*_FACTORIES, *(name for name in list_cards() if name not in _FACTORIES and is_technique(name)))


def is_known(name: str) -> bool:
    """Return True if `name` is a technique or the card of a network."""
    return name in _FACTORIES or name in list_cards()


def read_parameters(name: str) -> dict[str, Any]:
    """Return the parameters of the technique `name`, each with its default. Raises UsageError for an unknown technique
    or a network that only outputs feature maps, and ModelError for a card that cannot be read."""
    return {key: p.default for key, p in inspect.signature(_find_factory(name)).parameters.items()}


def format_name(name: str, form: str | None) -> str:
    """Return the technique and its `form` (see the glossary) as one name, such as "hog 8bit". The form is omitted if it
    is the default, `float`, or None (the technique has no forms)."""
    return name if form in (None, "float") else f"{name} {form}"


def create(name: str, settings: dict[str, Any] | None = None) -> Technique:
    """Create the technique `name`. `settings` are parameter values by name (None: use the defaults); a string is
    converted to the type of its parameter. Raises UsageError for an unknown technique or parameter and for an invalid
    value, and ModelError for a network that cannot be used."""
    defaults = read_parameters(name)
    values = {}
    for key, value in (settings or {}).items():
        if key not in defaults:
            hint = suggest(key, defaults, f"it has {', '.join(defaults)}.")
            if key == "camera":
                hint = "it works with every camera direction: omit --camera."
            raise UsageError(f"{name} has no parameter `{key}`: {hint}")
        value_type = type(defaults[key])
        try:
            values[key] = value_type(value)
        except ValueError:
            raise UsageError(f"{name}: `{key}` is {value!r}, but must be {_TYPE_NAMES[value_type]}.") from None
    technique: Technique = _find_factory(name)(**values)
    return technique


def _find_factory(name: str) -> Callable[..., Any]:
    """Return what creates the technique `name` from its parameters. Raises the errors of `read_parameters`."""
    if name in _FACTORIES:
        factory: Callable[..., Any] = resolve_name(f"edgevpr.techniques.{_FACTORIES[name]}")
        return factory
    if not is_known(name):
        raise UsageError(f"There is no technique `{name}`: use one of {', '.join(list_techniques())}.")
    card = load_card(name)
    if not card.is_technique:
        raise UsageError(f"The network `{name}` has no descriptor output: use it as the `model` of a technique.")
    from edgevpr.techniques.network import make_from_card

    return partial(make_from_card, card)
