"""Every technique in each of its forms, for the commands that list them, and why some cannot be used here."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from edgevpr import techniques
from edgevpr.core.config import FORMS
from edgevpr.core.contract import Technique
from edgevpr.core.errors import ModelError
from edgevpr.power.boards import Board
from edgevpr.runtime.recognise.opening import made_for
from edgevpr.techniques import labelled


@dataclass(frozen=True, slots=True)
class Offer:
    """A technique with its settings, one of which may be its form; `label` tells it from other offers."""

    label: str
    name: str
    settings: dict[str, Any]


def offers(
    names: Iterable[str], forms: Iterable[str] = FORMS, settings: Mapping[str, Mapping[str, Any]] | None = None
) -> tuple[Offer, ...]:
    """List each technique in each of `forms`, or once where it has none; `settings` are by technique name.

    Raises UsageError for an unknown name, and ModelError for a card that is incomplete.
    """
    found = []
    for name in names:
        own = dict((settings or {}).get(name, {}))
        if "form" in own or "form" not in techniques.parameters(name):
            found.append(Offer(labelled(name, own.get("form")), name, own))
        else:
            found += [Offer(labelled(name, form), name, {**own, "form": form}) for form in forms]
    return tuple(found)


def usable(wanted: Iterable[Offer], board: Board | None = None) -> Iterator[tuple[Offer, Technique | ModelError]]:
    """Make each technique for `board`, or give the error that says why it cannot be used.

    An error is given once for all forms of a technique, under its name.
    """
    refused = set()
    for offer in wanted:
        if offer.name in refused:
            continue
        try:
            yield offer, made_for(board, offer.name, offer.settings)
        except ModelError as error:
            refused.add(offer.name)
            yield Offer(offer.name, offer.name, offer.settings), error
