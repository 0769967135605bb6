"""Accuracy of each technique on image sets, as `make results` measured it, for a camera that looks down or forward.

The figures (accuracy.json) are installed with the program, so that no cost is ever shown without accuracy.
"""

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

PATH = Path(__file__).with_name("accuracy.json")
_FEWER = "{}, {} candidates"


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Accuracy of a technique in one form. `recall_at_1`: share of queries whose best place is right, 0..1, the mean
    over the `sets` image sets that nothing was tuned on, with `queries` queries in total.

    `asked`: queries of all image sets. `accepted`: those whose best place was accepted. `accepted_wrong`: those whose
    accepted place was wrong. `accepted_elsewhere`: those whose accepted place was not even a neighbour of the right
    one.
    """

    recall_at_1: float
    sets: int
    queries: int
    asked: int
    accepted: int
    accepted_wrong: int
    accepted_elsewhere: int

    @property
    def is_trusted(self) -> bool:
        """Tell whether no query was accepted as a place far from the right one."""
        return self.accepted_elsewhere == 0

    def __str__(self) -> str:
        sets = f"{self.sets} image sets" if self.sets > 1 else "one image set"
        beside = self.accepted_wrong - self.accepted_elsewhere
        wrong = f"{self.accepted_elsewhere} wrong" + (f" ({beside} as a neighbour)" if beside else "")
        return f"recall@1 {self.recall_at_1:.2f} on {sets}, {self.accepted} of {self.asked} accepted, {wrong}"


def labelled(label: str, candidates: int | None) -> str:
    """Return `label` (technique and form), followed by the number of candidates unless that is the default (None)."""
    return label if candidates is None else _FEWER.format(label, candidates)


def of(label: str, camera: str | None, candidates: int | None = None) -> Accuracy | None:
    """Return the accuracy of `label` (technique and form, see `techniques.labelled`); None if it was not measured.

    `camera`: "nadir" (looks down) or "forward" (None: forward). `candidates`: fewer than the default (None: the
    default).
    """
    figures = _content()[camera or "forward"].get(labelled(label, candidates))
    return Accuracy(**figures) if figures else None


def fewer_candidates(label: str, camera: str | None) -> tuple[int, ...]:
    """Return the numbers of candidates, below the default, with which a technique was measured, largest first."""
    before, after = _FEWER.format(label, "|").split("|")
    names = (name for name in _content()[camera or "forward"] if name.startswith(before) and name.endswith(after))
    return tuple(sorted((int(name[len(before) : -len(after)]) for name in names), reverse=True))


@lru_cache(maxsize=1)
def _content() -> dict[str, dict[str, dict[str, Any]]]:
    content: dict[str, dict[str, dict[str, Any]]] = json.loads(PATH.read_text("utf-8"))
    return content
