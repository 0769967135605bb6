"""Measures techniques on data sets for `edgevpr eval`: maps the references, runs queries as in flight, judges and sums
up the answers.

Numbers in parentheses are sections and equations of the thesis (Mubariz Zaffar, *Visual Place Recognition for
Autonomous Robots*)."""

import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.config import BatteryConfig, MatchConfig, SalienceConfig, SourceConfig
from edgevpr.core.contract import Technique, TechniqueSpec
from edgevpr.core.errors import EdgevprError, ImageError, ModelError, UsageError
from edgevpr.core.text import Progress, iterate_silently
from edgevpr.core.types import NO_COST, Frame, StageCost
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.positions import GeoTag
from edgevpr.frames.source import open_source, read_tags, read_to_end
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.dataset import Dataset, ScoredQuery
from edgevpr.lab.evaluate.provenance import describe_origin
from edgevpr.mapmaking.finishing import finish_map, make_encoder
from edgevpr.mapmaking.mapping import build_map
from edgevpr.mapmaking.pictures import FlightPictures
from edgevpr.places.index import PlaceIndex, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import outside_neighbourhood
from edgevpr.places.sequence import make_sequence_search
from edgevpr.power.boards import load_board
from edgevpr.power.equations import parse_pack, queries_ah
from edgevpr.power.meter import QueryMeter, compute_query_cost
from edgevpr.runtime.preflight.probe import compute_disk_bytes, compute_ram_bytes
from edgevpr.runtime.recognise.calibration import read_calibration_for
from edgevpr.runtime.recognise.decide import Matcher, MatchSettings
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.hints import RecordedPrior, explain_why_unusable, parse_known_fields
from edgevpr.runtime.recognise.judge import make_accept_rule
from edgevpr.runtime.recognise.opening import open_salience_gate
from edgevpr.runtime.recognise.place_filter import PlaceFilter
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.runtime.recognise.salience_gate import SalienceGate
from edgevpr.techniques import create, format_name
from edgevpr.techniques.card import describe_weights


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchOptions:
    """Options of matching. `candidates`: number of places to compare in full (None: the technique's own number, as in
    flight). `exact`: compare all places in full, without a scan. `sequence`: number of successive queries, in the order
    of their names, to match together (None: the technique's own number). `follow`: track the queries with the place
    filter, as frames of one flight. `known`: prior knowledge about each query, such as "heading,height" (see
    `hints.RecordedPrior`; None: none)."""

    candidates: int | None = None
    sequence: int | None = None
    exact: bool = False
    follow: bool = False
    known: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryAnswer:
    """The judged answer to one query. `has_match`: its place is in the map. `found` is the name of the best reference
    that is not ignored (None: none), and `score` its score (-inf: none). `first_right` is the rank, from 0, of the
    first correct reference (infinite: none).

    `accepted`: a flight would have accepted the match. `accepted_wrong`: accepted, and wrong. `accepted_off_map`:
    accepted, and the query's place is not in the map. `accepted_elsewhere`: accepted, wrong, and not a neighbour of a
    correct or ignored reference (`outside_neighbourhood`). `discarded`: the salience gate discarded the query as not
    memorable. `encoding` and `matching` are the costs of the two stages."""

    query: str
    has_match: bool
    found: str | None
    score: float
    first_right: float
    accepted: bool
    accepted_wrong: bool
    accepted_off_map: bool
    accepted_elsewhere: bool
    discarded: bool
    encoding: StageCost
    matching: StageCost


def answer_queries(
    technique: Technique, dataset: Dataset, options: MatchOptions, progress: Progress, gate: SalienceGate | None = None
) -> tuple[list[QueryAnswer], tuple[str, ...]]:
    """Map the references of `dataset` in a temporary file and run every query. Return the judged answers to the scored
    queries, and the map's failed steps (see `open_temporary_map`). `gate` discards unmemorable queries (None: none);
    the map has all references, as in the thesis (3.3). Raises UsageError if no query has what `options.known` requires,
    ImageError and ModelError if an image, network or query fails, MapError if the map cannot be written."""
    spec = technique.spec
    prior, tags = read_prior(options.known, dataset, spec, options.sequence)
    sequence = options.sequence or spec.sequence
    meter = QueryMeter(load_board("this"))
    source = open_source(str(dataset.ref_dir), live=False, upright=not spec.looks_down)
    # An unusable image raises ImageError, because figures that omit images would mislead.
    frames = filter(None, progress(read_to_end(source), source.total, f"{spec.name}: references"))
    with open_temporary_map(frames, technique, dataset.ref_dir, progress) as (place_map, index, not_done):
        rule = make_accept_rule(technique, MatchConfig(), sequence, read_calibration_for(place_map))
        tracks_flight = options.follow and sequence == 1 and rule.confidence_rule is not None
        candidates = None if options.exact else options.candidates or technique.candidates

        def make_recogniser(sequence_length: int, tracks_flight: bool) -> Recogniser:
            return Recogniser(
                FrameEncoder(technique=technique, gate=gate),
                place_map,
                Matcher(index, rule, make_sequence_search(sequence_length)),
                meter,
                settings=MatchSettings(candidates=candidates),
                prior=prior,
                place_filter=PlaceFilter(place_map, max_speed_m_s=None, is_live=False) if tracks_flight else None,
            )

        scored = {query.path.name: query for query in dataset.queries}
        paths = [query.path for query in dataset.queries]
        # Run one query without measuring it, because the first one is slowed down by lazy imports and a cold disk.
        _recognise(make_recogniser(1, False), paths[0], GeoTag())
        if gate:
            gate.reset()
        if sequence > 1 or tracks_flight:  # a sequence includes the queries that are not scored
            paths = list_images(paths[0].parent)
        recogniser, answers = make_recogniser(sequence, tracks_flight), []
        for path in progress(paths, len(paths), f"{spec.name}: queries"):
            event = _recognise(recogniser, path, tags.get(path, GeoTag()))
            if query := scored.get(path.name):
                answers.append(_judge(event, query, dataset.references, index))
    return answers, not_done


@contextmanager
def open_temporary_map(
    frames: Iterable[Frame], technique: Technique, images: Path | None = None, progress: Progress = iterate_silently
) -> Iterator[tuple[PlaceMap, PlaceIndex, tuple[str, ...]]]:
    """Context manager: map `frames` in a temporary file, then refine and calibrate the map like `map build`. Yields the
    map, open for reading, an index of all its places, and a sentence for each step that failed. `images` is the folder
    that the frames come from (None: the map is not calibrated)."""

    def show_progress(items: Iterable[Any], total: int, label: str) -> Iterable[Any]:
        return progress(items, total, f"{technique.spec.name}: {label}")

    with tempfile.TemporaryDirectory(prefix="edgevpr-eval-") as folder:
        path = Path(folder) / "references.gpkg"
        with PlaceMap.create(path, technique.spec) as place_map:
            build_map(frames, FrameEncoder(technique=technique), place_map)
            pictures = FlightPictures(source=str(images)) if images else None
            encoder = make_encoder(SourceConfig(), pictures, technique)
            *_, not_done = finish_map(place_map, encoder, MatchConfig(), pictures, show_progress)
        with PlaceMap.open(path) as place_map:
            index = load_index(place_map, technique)
            # Drop the name of the temporary folder, which is deleted afterwards and differs in every run.
            yield place_map, index, tuple(sentence.replace(f"{folder}/", "") for sentence in not_done)


def summarise(
    technique: Technique,
    dataset: Dataset,
    answers: Sequence[QueryAnswer],
    options: MatchOptions,
    not_done: tuple[str, ...] = (),
) -> metrics.TechniqueResult:
    """Return the result of `technique`, without the PCU, from its answers to all queries. `options` are those of the
    queries, and `not_done` lists the steps that failed for the map."""
    queries, references = len(answers), len(dataset.references)
    sequence = options.sequence or technique.spec.sequence
    battery, board = BatteryConfig(), load_board("this")
    efficiency = battery.regulator_efficiency
    encoding, matching = (
        sum(costs, start=NO_COST) * (1 / queries)
        for costs in ([answer.encoding for answer in answers], [answer.matching for answer in answers])
    )
    cost = compute_query_cost(encoding, matching, board, parse_pack(battery.pack), efficiency, rss_mb=0.0)
    return metrics.TechniqueResult(
        technique=format_name(technique.spec.name, technique.spec.form),
        weights=describe_weights(technique.spec),
        parameters=technique.spec.parameters,
        references=references,
        unscored=dataset.unscored,
        queries_copied=dataset.copied,
        not_done=not_done,
        **metrics.compute_quality(
            *(np.array([getattr(answer, name) for answer in answers]) for name in ("score", "first_right", "has_match"))
        ),
        **{
            name: sum(getattr(answer, name) for answer in answers)
            for name in ("accepted", "accepted_wrong", "accepted_off_map", "accepted_elsewhere", "discarded")
        },
        t_encode_s=cost.t_encode_s,
        t_match_s=cost.t_match_s,
        t_match_per_ref_s=cost.t_match_s / references,
        descriptor_bytes=compute_ram_bytes(technique.spec, sequence),
        fine_bytes=compute_disk_bytes(technique.spec),
        u_encode=cost.u_encode,
        u_match=cost.u_match,
        ah_total=queries_ah(queries, cost.used_mah / 1000),
        sequence=sequence,
        known=options.known and ",".join(parse_known_fields(options.known)),
        ah_assumes=(
            f"{board.title}, {board.idle_w:g} W idle and {board.full_w:g} W at full load ({board.source}), "
            f"pack {battery.pack}, regulator efficiency {efficiency:g}"
        ),
    )


def read_prior(
    text: str | None, dataset: Dataset, spec: TechniqueSpec, sequence: int | None
) -> tuple[RecordedPrior | None, dict[Path, GeoTag]]:
    """Return the prior that narrows the search for each query of a data set, and the tags of the queries by path.
    `text` lists the data to use ("heading,height"; None: none). The map height is the median height of its pictures.
    `sequence`: see `MatchOptions`. Raises UsageError if `text` is invalid, or if no query has what it lists."""
    if not (parts := parse_known_fields(text)):
        return None, {}
    queries, places = read_tags(dataset.queries[0].path.parent), read_tags(dataset.ref_dir)
    if problem := explain_why_unusable(parts, queries.values(), places.values(), sequence or spec.sequence):
        raise UsageError(problem)
    query_heights_m, map_heights_m = (
        [tag.height_m for tag in tags.values() if tag.height_m is not None and tag.height_m > 0]
        for tags in (queries, places)
    )
    map_height_m = float(np.median(map_heights_m)) if query_heights_m and map_heights_m else None
    return RecordedPrior(parts, spec.heading_within_deg, map_height_m), queries


def _recognise(recogniser: Recogniser, path: Path, tag: GeoTag) -> Recognition:
    """Recognise the image at `path`, given its `tag`. Raises ModelError if it fails: figures without it mislead."""
    event = recogniser.step(
        Frame(
            image=read_image(path, upright=not recogniser.technique.spec.looks_down),
            name=path.name,
            t_mono_s=0.0,  # constant, so that there are no time gaps
            position=tag.position,
            heading_deg=tag.heading_deg,
            height_m=tag.height_m,
        )
    )
    if event.failed:
        raise ModelError(str(event.reason))
    return event


def _judge(event: Recognition, query: ScoredQuery, references: Sequence[str], index: PlaceIndex) -> QueryAnswer:
    """Judge the recognition of `query`. `references`: names of all places, in mapping order, as in the index."""
    discarded = event.salience is not None and event.salience.reason is not None
    ranking = None if discarded else event.ranking
    slots = ranking.slots if ranking else np.empty(0, np.intp)
    correct, ignored = (np.array([name in names for name in references]) for names in (query.correct, query.ignored))
    scored = np.flatnonzero(~ignored[slots])
    wrong = event.accepted and not (correct | ignored)[slots[0]]
    is_elsewhere = wrong and outside_neighbourhood(index, slots[0], np.flatnonzero(correct | ignored), 0.0).all()
    return QueryAnswer(
        query=query.path.name,
        has_match=bool(query.correct),
        found=references[slots[scored[0]]] if len(scored) else None,
        score=float(ranking.scores[scored[0]]) if ranking and len(scored) else -math.inf,
        first_right=metrics.rank_of_first_correct(slots[scored], correct),
        accepted=event.accepted,
        accepted_wrong=bool(wrong),
        accepted_off_map=bool(wrong and not query.correct),
        accepted_elsewhere=bool(is_elsewhere),
        discarded=discarded,
        encoding=event.steps.encoding,
        matching=event.steps.match,
    )


@dataclass(frozen=True, slots=True)
class Measurements:
    """Outcome of a run. `measured`: results of the rows, by set. `answers`: judged answers to their queries, by set and
    label. `failed`: errors of rows that could not be measured, by set and label."""

    measured: dict[str, list[metrics.TechniqueResult]]
    answers: dict[tuple[str, str], Sequence[QueryAnswer]]
    failed: dict[tuple[str, str], EdgevprError]

    def as_json(self) -> dict[str, Any]:
        """Return all results and answers, with date, machine and versions, for `json.dumps`."""
        return {
            **describe_origin(),
            "results": [
                {
                    "set": name,
                    "row": result.technique,
                    **asdict(result),
                    "answers": list(map(_serialise_answer, self.answers[name, result.technique])),
                }
                for name, results in self.measured.items()
                for result in results
            ],
            "failed": [{"set": name, "row": row, "why": str(error)} for (name, row), error in self.failed.items()],
        }


def _serialise_answer(answer: QueryAnswer) -> dict[str, Any]:
    """Return the fields of an answer for JSON, with null in place of infinite values."""
    fields = asdict(answer)
    return fields | {name: None for name in ("score", "first_right") if not math.isfinite(fields[name])}


def measure(
    sets: Mapping[str, Dataset],
    rows: Mapping[str, tuple[str, dict[str, Any]]],
    options: MatchOptions,
    salience: SalienceConfig,
    progress: Progress,
) -> Measurements:
    """Measure every row on every set. `sets`: data sets by name. `rows`: (technique, settings) by label. Raises
    UsageError for an unknown technique or parameter. If a network or picture cannot be used, only its row fails."""
    outcome = Measurements({}, {}, {})
    for name, dataset in sets.items():
        results = []
        for label, (technique_name, settings) in rows.items():
            technique, gate = create(technique_name, settings), open_salience_gate(salience)
            try:
                answers, not_done = answer_queries(technique, dataset, options, progress, gate)
            except (ModelError, ImageError) as error:  # the other rows continue
                outcome.failed[name, label] = error
            else:
                results.append(replace(summarise(technique, dataset, answers, options, not_done), technique=label))
                outcome.answers[name, label] = answers
        outcome.measured[name] = metrics.add_pcu(results)
    return outcome
