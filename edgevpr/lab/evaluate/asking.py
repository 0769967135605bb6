"""The queries of a data set, asked one by one by the code that flies, and what each answer is worth."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from edgevpr.core.config import bounded, load_config
from edgevpr.core.contract import Technique
from edgevpr.core.errors import ModelError
from edgevpr.core.types import Frame, StageCost
from edgevpr.frames.images import list_images, read_image
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.dataset import Dataset, ScoredQuery
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import Ranking, elsewhere
from edgevpr.places.sequence import length_of, search_of
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.evidence import calibration_of
from edgevpr.runtime.recognise.follow import Follower
from edgevpr.runtime.recognise.judge import accept_rule
from edgevpr.runtime.recognise.recogniser import Matcher, Preparation, Recogniser, WalkSettings
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.runtime.recognise.salience_gate import Gate

T = TypeVar("T")
Progress = Callable[[Iterable[T], int, str], Iterable[T]]
_NOTHING_FOUND = Ranking(np.empty(0, np.intp), np.empty(0, np.float32), {})  # a picture that says nothing


def optional(low: float, high: float) -> Any:
    """Make a field that is None unless it is given, and then lies in low..high."""
    return field(default=None, metadata=bounded(low, high).metadata)


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchOptions:
    """Manner of matching: `candidates` places are compared (None: the technique's own number, as it flies); with
    `exact` all are, and the scan chooses none. `sequence` queries are matched together, in the order of their names
    (None: the technique's own number); with `follow` they are followed as those of one flight."""

    candidates: int | None = optional(1, 1_000_000)
    sequence: int | None = optional(1, 100)
    exact: bool = False
    follow: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryAnswer:
    """The answer to one query: the reference that was `found`, its score and the rank of the first right one (from 0,
    infinite: there is none), all among the references that count. `accepted`: the flight would have accepted the match;
    `accepted_wrong`: it would have, and the match is wrong; `accepted_elsewhere`: and not beside a right one either.
    `discarded`: the query was not memorable. `encoding` and `matching` are the costs of the two stages."""

    query: str
    found: str | None
    score: float
    first_right: float
    accepted: bool
    accepted_wrong: bool
    accepted_elsewhere: bool
    discarded: bool
    encoding: StageCost
    matching: StageCost

    @property
    def is_right(self) -> bool:
        """True where the best match is right."""
        return self.first_right == 0


class Walk:
    """A recogniser that is ready to be asked, and how it is asked. `length` queries are matched together, and where
    `is_in_order` an answer depends on the queries before it."""

    def __init__(
        self,
        technique: Technique,
        place_map: PlaceMap,
        index: PlaceIndex,
        meter: QueryMeter,
        *,
        options: MatchOptions,
        gate: Gate | None = None,
    ) -> None:
        self.length = length_of(technique.spec, options.sequence)
        rule = accept_rule(technique, load_config(None).match, self.length, calibration_of(place_map))
        follows = options.follow and self.length == 1 and rule.sure is not None
        self.is_in_order = self.length > 1 or follows

        def recogniser(length: int, follows: bool) -> Recogniser:
            return Recogniser(
                Matcher(technique, index, rule, search_of(length)),
                place_map,
                meter,
                WalkSettings(candidates=None if options.exact else options.candidates or technique.candidates),
                preparation=Preparation(gate=gate),
                follower=Follower(place_map, fastest_m_s=None, is_live=False) if follows else None,
            )

        self._once, self._gate = recogniser(1, False), gate
        self.recogniser = recogniser(self.length, follows)

    def warm_up(self, path: Path) -> None:
        """Ask a query that is not counted: the first one pays for lazy imports, tables and a cold disk."""
        asked(self._once, path)
        if self._gate:
            self._gate.forget()


def answer_of(event: Recognition, query: ScoredQuery, references: Sequence[str], index: PlaceIndex) -> QueryAnswer:
    """Judge what was recognised. `references` are the names of all places, in the order in which they were mapped."""
    discarded = event.worth is not None and event.worth.reason is not None
    ranking = (None if discarded else event.ranking) or _NOTHING_FOUND
    # Slots of the index follow the order of mapping, which is that of the references' names.
    right = np.array([name in query.right for name in references])
    ignored = np.array([name in query.ignored for name in references])
    at = metrics.counting(ranking.slots, ignored)
    wrong = event.accepted and not (right | ignored)[ranking.slots[0]]
    away = wrong and elsewhere(index, ranking.slots[0], np.flatnonzero(right | ignored), 0.0).all()
    return QueryAnswer(
        query=query.path.name,
        found=references[ranking.slots[at[0]]] if len(at) else None,
        score=float(ranking.scores[at[0]]) if len(at) else 0.0,
        first_right=metrics.first_right(ranking.slots[at], right),
        accepted=event.accepted,
        accepted_wrong=bool(wrong),
        accepted_elsewhere=bool(away),
        discarded=discarded,
        encoding=event.steps.encoding,
        matching=event.steps.match,
    )


def answers(walk: Walk, dataset: Dataset, progress: Progress[Path]) -> Iterator[QueryAnswer]:
    """Ask all queries of a data set, and yield the answers of those that are scored."""
    recogniser = walk.recogniser
    scored = {query.path.name: query for query in dataset.queries}
    paths = [query.path for query in dataset.queries]
    if walk.is_in_order:  # those that are not scored are part of a sequence as well
        paths = list_images(paths[0].parent)
    for path in progress(paths, len(paths), f"{recogniser.technique.spec.name}: queries"):
        event = asked(recogniser, path)
        if query := scored.get(path.name):
            yield answer_of(event, query, dataset.references, recogniser.index)


def asked(recogniser: Recogniser, path: Path) -> Recognition:
    """Recognise one image. A failure ends the evaluation (ModelError): a set with holes measures nothing."""
    event = recogniser.step(Frame(image=read_image(path), name=path.name, t_mono_s=0.0))  # a folder has no gaps
    if event.failed:
        raise ModelError(event.reason)
    return event
