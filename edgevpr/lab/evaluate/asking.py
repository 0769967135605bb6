"""Asks the queries of a data set one by one, with the recogniser of a flight, told what is known of them beside their
pictures, and judges each by ground truth."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from edgevpr.core.config import bounded, load_config
from edgevpr.core.contract import Technique, TechniqueSpec
from edgevpr.core.errors import ModelError, UsageError
from edgevpr.core.types import Frame, StageCost
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.positions import GeoTag
from edgevpr.frames.source import tags_of
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.dataset import Dataset, ScoredQuery
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import Ranking, elsewhere
from edgevpr.places.sequence import length_of, search_of
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.evidence import calibration_of
from edgevpr.runtime.recognise.follow import Follower
from edgevpr.runtime.recognise.hints import Told, lacking, told_parts
from edgevpr.runtime.recognise.judge import accept_rule
from edgevpr.runtime.recognise.preparation import Preparation
from edgevpr.runtime.recognise.recogniser import Matcher, Recogniser, WalkSettings
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.runtime.recognise.salience_gate import Gate

T = TypeVar("T")
NO_TAG = GeoTag()
Progress = Callable[[Iterable[T], int, str], Iterable[T]]  # yields the items, of that number, and shows it with a label
# Of a discarded query, for example.
_NOTHING_FOUND = Ranking(slots=np.empty(0, np.intp), scores=np.empty(0, np.float32), compared={})


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchOptions:
    """Options of matching. `candidates`: how many places are compared in full (None: the technique's own number, as in
    flight); with `exact` all are, without a scan. `sequence`: how many successive queries, in the order of their names,
    are matched together (None: the technique's own number). `follow`: the filter follows them as one flight's frames.
    `known`: what each is told beside its picture, such as "heading,height" (None: nothing, see `hints.Told`).
    """

    candidates: int | None = bounded(1, 1_000_000, default=None)
    sequence: int | None = bounded(1, 100, default=None)
    exact: bool = False
    follow: bool = False
    known: str | None = None


def known_of(
    text: str | None, dataset: Dataset, spec: TechniqueSpec, sequence: int | None
) -> tuple[Told | None, dict[Path, GeoTag]]:
    """Return what narrows each query of a data set, where `text` says what is known ("heading,height"; None: nothing),
    and the tags of the queries by path. The height of the map is the median of those of its pictures. `sequence` is
    that of `MatchOptions`. Raises UsageError if no query has what is asked for, and for a text that cannot be read."""
    if not (parts := told_parts(text)):
        return None, {}
    queries, places = tags_of(dataset.queries[0].path.parent), tags_of(dataset.ref_dir)
    if why := lacking(parts, queries.values(), places.values(), length_of(spec, sequence)):
        raise UsageError(why)
    of_queries, of_places = (
        [tag.height_m for tag in side.values() if tag.height_m is not None and tag.height_m > 0]
        for side in (queries, places)
    )
    map_height_m = float(np.median(of_places)) if of_queries and of_places else None
    return Told(parts, spec.heading_within_deg, map_height_m), queries


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryAnswer:
    """The judged answer to one query. `found` is the name of the best reference that is not ignored (None: there is
    none) and `score` its score; `first_right` is the rank of the first right reference, from 0 (infinite: none).

    `accepted`: a flight would have accepted the match; `accepted_wrong`: and it is wrong; `accepted_elsewhere`: and it
    is no neighbour of a right or ignored reference (`places.retrieve.elsewhere`). `discarded`: the salience gate
    dropped the query as not memorable. `encoding` and `matching` are the costs of the two stages.
    """

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
    """A recogniser that is open on a map and set up by `options`, for asking one query after another. `is_in_order` is
    True if an answer depends on the queries before it. `prior` narrows each query (None: nothing is known of it)."""

    def __init__(
        self,
        technique: Technique,
        place_map: PlaceMap,
        index: PlaceIndex,
        meter: QueryMeter,
        *,
        options: MatchOptions,
        gate: Gate | None = None,
        prior: Told | None = None,
    ) -> None:
        together = length_of(technique.spec, options.sequence)
        rule = accept_rule(technique, load_config(None).match, together, calibration_of(place_map))
        follows = options.follow and together == 1 and rule.sure is not None
        self.is_in_order = together > 1 or follows

        def recogniser(length: int, follows: bool) -> Recogniser:
            return Recogniser(
                Matcher(technique, index, rule, search_of(length)),
                place_map,
                meter,
                WalkSettings(candidates=None if options.exact else options.candidates or technique.candidates),
                preparation=Preparation(gate=gate),
                prior=prior,
                follower=Follower(place_map, fastest_m_s=None, is_live=False) if follows else None,
            )

        self._once, self._gate = recogniser(1, False), gate
        self.recogniser = recogniser(together, follows)

    def warm_up(self, path: Path) -> None:
        """Recognise the image `path` without counting it: the first query pays for lazy imports and a cold disk."""
        asked(self._once, path)
        if self._gate:
            self._gate.forget()


def answer_of(event: Recognition, query: ScoredQuery, references: Sequence[str], index: PlaceIndex) -> QueryAnswer:
    """Judge the recognition `event` of `query`. `references` are the names of all places, in the order of mapping."""
    discarded = event.worth is not None and event.worth.reason is not None
    ranking = (None if discarded else event.ranking) or _NOTHING_FOUND
    # The slots of the index are in the order of mapping, as `references` are.
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


def answers(
    walk: Walk, dataset: Dataset, progress: Progress[Path], tags: Mapping[Path, GeoTag] | None = None
) -> Iterator[QueryAnswer]:
    """Ask all queries of `dataset`, of which `tags` are known (None: none), and yield one judged answer for each that
    is scored."""
    recogniser = walk.recogniser
    scored = {query.path.name: query for query in dataset.queries}
    paths = [query.path for query in dataset.queries]
    if walk.is_in_order:  # those that are not scored are part of a sequence as well
        paths = list_images(paths[0].parent)
    for path in progress(paths, len(paths), f"{recogniser.technique.spec.name}: queries"):
        event = asked(recogniser, path, (tags or {}).get(path, NO_TAG))
        if query := scored.get(path.name):
            yield answer_of(event, query, dataset.references, recogniser.index)


def asked(recogniser: Recogniser, path: Path, tag: GeoTag = NO_TAG) -> Recognition:
    """Recognise the image `path`, of which `tag` is known. Raises ModelError if that fails: figures without some
    queries would mislead."""
    frame = Frame(
        image=read_image(path),
        name=path.name,
        t_mono_s=0.0,  # without gaps in time
        position=tag.position,
        heading_deg=tag.heading_deg,
        height_m=tag.height_m,
    )
    event = recogniser.step(frame)
    if event.failed:
        raise ModelError(event.reason)
    return event
