"""The registry of the techniques of place recognition: their names, their parameters, and how to make one.

Map building, flights and evaluations make every technique here; its module is imported only then. "The thesis", in this
package, is Mubariz Zaffar, *Visual Place Recognition for Autonomous Robots*. A card is a YAML file about a network.
"""

import inspect
from collections.abc import Callable
from functools import partial
from pkgutil import resolve_name
from typing import Any

from edgevpr.core.contract import Technique
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.text import suggest

# The class or function that makes each technique of edgevpr itself.
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
# The default is the first of these that fits the board. Networks are never the default: they need onnxruntime in RAM,
# and weights that a person has chosen. Nor is `seqslam`: a sequence needs a flight along the mapped route.
DEFAULT_TECHNIQUES = ("cohog", "hog")
CONFIDENCE_TECHNIQUE = "cohog"  # the one whose matches have a confidence
_TYPE_NAMES = {int: "a whole number", float: "a number", str: "a word"}


def list_techniques() -> tuple[str, ...]:
    """Return the names of all techniques: those of edgevpr, then the networks whose cards give a descriptor. Cards that
    cannot be read are left out; one with the name of a technique of edgevpr only supplies its weights."""
    from edgevpr.techniques.card import list_cards, load_card

    def is_technique(card: str) -> bool:
        try:
            return load_card(card).is_technique
        except EdgevprError:
            return False

    return (*_FACTORIES, *(name for name in list_cards() if name not in _FACTORIES and is_technique(name)))


def is_known(name: str) -> bool:
    """Tell whether `name` is a technique or the card of a network."""
    from edgevpr.techniques.card import list_cards

    return name in _FACTORIES or name in list_cards()


def read_parameters(name: str) -> dict[str, Any]:
    """Return the parameters of the technique `name`, each with its default. Raises UsageError for an unknown technique
    or a network that gives feature maps only, ModelError for a card that cannot be read."""
    return {key: p.default for key, p in inspect.signature(_find_factory(name)).parameters.items()}


def format_name(name: str, form: str | None) -> str:
    """Return the technique and its `form` (see the glossary) as one name, such as "hog 8bit". The default form `float`,
    and None (the technique has no forms), are left out."""
    return name if form in (None, "float") else f"{name} {form}"


def create(name: str, settings: dict[str, Any] | None = None) -> Technique:
    """Make the technique `name`. `settings` are values of its parameters by name (None: all defaults); a text is
    converted to the type of its parameter. Raises UsageError for an unknown technique or parameter and for a wrong
    value, and ModelError for a network that cannot be used."""
    defaults = read_parameters(name)
    values = {}
    for key, value in (settings or {}).items():
        if key not in defaults:
            hint = suggest(key, defaults, f"it has {', '.join(defaults)}.")
            if key == "camera":
                hint = "it takes images of every direction: leave out --camera."
            raise UsageError(f"{name} has no parameter `{key}`: {hint}")
        kind = type(defaults[key])
        try:
            values[key] = kind(value)
        except ValueError:
            raise UsageError(f"{name}: `{key}` is {value!r}; it must be {_TYPE_NAMES[kind]}.") from None
    technique: Technique = _find_factory(name)(**values)
    return technique


def _find_factory(name: str) -> Callable[..., Any]:
    """Return the class or function that makes the technique `name`; its arguments are the technique's parameters.
    Raises as `read_parameters` does."""
    if name in _FACTORIES:
        factory: Callable[..., Any] = resolve_name(f"edgevpr.techniques.{_FACTORIES[name]}")
        return factory
    if not is_known(name):
        raise UsageError(f"There is no technique `{name}`: use one of {', '.join(list_techniques())}.")
    from edgevpr.techniques.card import load_card

    card = load_card(name)
    if not card.is_technique:
        raise UsageError(f"The network `{name}` gives no descriptor: use it as the `model` of a technique.")
    from edgevpr.techniques.network import make_from_card

    return partial(make_from_card, card)
