"""Accuracy of each technique: the figures of `make results`, by the way the camera looks.

They travel with the program, so that what a technique costs is never said without what it finds.
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
    """Accuracy of a technique in one form: `recall_at_1` (0..1) is the mean over the `sets` that nothing was tuned on,
    which have `queries` in all. Of `asked` queries of all sets `accepted` were accepted, `accepted_wrong` of them
    wrongly, `accepted_elsewhere` of these as a place that is no neighbour of the right one."""

    recall_at_1: float
    sets: int
    queries: int
    asked: int
    accepted: int
    accepted_wrong: int
    accepted_elsewhere: int

    @property
    def is_trusted(self) -> bool:
        """Tell whether no place far from the right one was ever accepted."""
        return self.accepted_elsewhere == 0

    def __str__(self) -> str:
        sets = f"{self.sets} image sets" if self.sets > 1 else "one image set"
        beside = self.accepted_wrong - self.accepted_elsewhere
        wrong = f"{self.accepted_elsewhere} wrong" + (f" ({beside} as a neighbour)" if beside else "")
        return f"recall@1 {self.recall_at_1:.2f} on {sets}, {self.accepted} of {self.asked} accepted, {wrong}"


def labelled(label: str, candidates: int | None) -> str:
    """Name a technique with fewer candidates than its own (None: its own)."""
    return label if candidates is None else _FEWER.format(label, candidates)


def of(label: str, camera: str | None, candidates: int | None = None) -> Accuracy | None:
    """Return the accuracy of a technique in a form (see `techniques.labelled`), for a `camera` that looks "nadir" or
    "forward" (None: forward), with fewer `candidates` than its own (None: its own); None where it was not measured."""
    figures = _content()[camera or "forward"].get(labelled(label, candidates))
    return Accuracy(**figures) if figures else None


def fewer_candidates(label: str, camera: str | None) -> tuple[int, ...]:
    """Return the numbers of candidates, fewer than its own, with which a technique was measured, largest first."""
    before, after = _FEWER.format(label, "|").split("|")
    names = (name for name in _content()[camera or "forward"] if name.startswith(before) and name.endswith(after))
    return tuple(sorted((int(name[len(before) : -len(after)]) for name in names), reverse=True))


@lru_cache(maxsize=1)
def _content() -> dict[str, dict[str, dict[str, Any]]]:
    content: dict[str, dict[str, dict[str, Any]]] = json.loads(PATH.read_text("utf-8"))
    return content
