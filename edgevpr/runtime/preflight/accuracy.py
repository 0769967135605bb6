"""Accuracy of each technique on image sets, as `make results` measured it, for a camera that looks down or forward.

The figures (accuracy.json) are installed with the program, so that no cost is ever shown without accuracy.
"""

import json
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

PATH = Path(__file__).with_name("accuracy.json")


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Accuracy of a technique in one form. `recall_at_1`: share of queries whose best place is right, 0..1, the mean
    over the `sets` image sets that nothing was tuned on, with `queries` queries in total.

    The other fields are numbers of queries. `asked`: all queries of all image sets, also of those used for tuning.
    `accepted`: their best place was accepted. `accepted_wrong`: it was accepted, and wrong. `accepted_elsewhere`: it
    was accepted, and not even a neighbour of the right place.
    """

    recall_at_1: float
    sets: int
    queries: int
    asked: int
    accepted: int
    accepted_wrong: int
    accepted_elsewhere: int

    @property
    def beside(self) -> str:
        """Number of accepted places that were wrong but neighbours of the right one, as text for a table such as
        " (+3 beside)"; empty for none."""
        count = self.accepted_wrong - self.accepted_elsewhere
        return f" (+{count} beside)" if count else ""

    def __str__(self) -> str:
        return (
            f"recall@1 {self.recall_at_1:.2f} on {self.sets} image sets, {self.accepted} of {self.asked} accepted, "
            f"{self.accepted_elsewhere} wrong{self.beside}"
        )


def labelled(label: str, candidates: int | None) -> str:
    """Return `label` (technique and form), followed by the number of candidates unless that is the default (None)."""
    return label if candidates is None else f"{label}, {candidates} candidates"


def of(label: str, camera: str | None, candidates: int | None = None) -> Accuracy | None:
    """Return the accuracy of `label` (technique and form, see `techniques.labelled`); None if it was not measured.

    `camera`: "nadir" (looks down) or "forward" (None: forward). `candidates`: number of places compared with a query,
    if fewer than the technique's default (None: the default).
    """
    figures = _content()[camera or "forward"].get(labelled(label, candidates))
    return Accuracy(**figures) if figures else None


def fewer_candidates(label: str, camera: str | None) -> tuple[int, ...]:
    """Return the numbers of candidates, below the default, with which a technique was measured, largest first."""
    known = (re.fullmatch(rf"{re.escape(label)}, (\d+) candidates", name) for name in _content()[camera or "forward"])
    return tuple(sorted((int(found[1]) for found in known if found), reverse=True))


@cache
def _content() -> dict[str, dict[str, dict[str, Any]]]:
    content: dict[str, dict[str, dict[str, Any]]] = json.loads(PATH.read_text("utf-8"))
    return content
