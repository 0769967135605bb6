"""The techniques, by name. Nothing of a technique is imported before it is asked for."""

import difflib
import importlib
import inspect
from typing import Any

from edgevpr.errors import UsageError
from edgevpr.types import Technique

# Best first: where several fit a board, the first is taken.
_REGISTRY = {
    "cohog": "edgevpr.techniques.cohog:CoHog",
    "hog": "edgevpr.techniques.hog:Hog",
}


def names() -> tuple[str, ...]:
    """Names of all techniques, best first."""
    return tuple(_REGISTRY)


def parameters(name: str) -> dict[str, Any]:
    """The parameters of the technique `name` and their defaults. Raises UsageError for an unknown technique."""
    return {key: p.default for key, p in inspect.signature(_class(name)).parameters.items()}


def create(name: str, settings: dict[str, Any] | None = None) -> Technique:
    """Make the technique `name` with `settings` (texts are read as the parameter's type; the rest is default).

    Raises UsageError for an unknown technique or parameter, a value that cannot be read, or one out of range.
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
    if name not in _REGISTRY:
        raise UsageError(f"There is no technique `{name}`: use one of {', '.join(_REGISTRY)}.")
    module, _, class_name = _REGISTRY[name].partition(":")
    return getattr(importlib.import_module(module), class_name)


_words = {int: "a whole number", float: "a number", str: "a word"}
