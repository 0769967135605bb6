"""Measurement of one technique on a data set: map the references, ask every query, sum up quality and costs.

Map file, index, retrieval and meter are those of a flight. `edgevpr eval` and `many` use this module. Numbers in
parentheses are sections and equations of the thesis (Mubariz Zaffar, *Visual Place Recognition for Autonomous Robots*).
"""

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.config import load_config
from edgevpr.core.contract import Technique
from edgevpr.core.errors import UsageError
from edgevpr.core.types import NO_COST, Frame
from edgevpr.frames.source import Source, open_source
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.asking import MatchOptions, Progress, QueryAnswer, Walk, answers, known_of
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.mapmaking.making import FlownPictures, calibrate_map, refine_map
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.index import PlaceIndex, bytes_per_place, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.sequence import length_of
from edgevpr.power.boards import load_board
from edgevpr.power.equations import pack_ah, parse_pack, queries_ah, stage_energy_j
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.preflight.probe import disk_bytes, ram_bytes
from edgevpr.runtime.recognise.hints import told_parts
from edgevpr.runtime.recognise.opening import meter_of
from edgevpr.runtime.recognise.salience_gate import Gate
from edgevpr.techniques import create, labelled
from edgevpr.techniques.card import weights_of


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueResult(metrics.Quality):
    """Result of a technique (in one form) on a data set: its quality, its weights and its cost.

    `accepted`, `accepted_wrong`, `accepted_elsewhere` and `discarded` count queries by the fields of `QueryAnswer`;
    a discarded query counts as missed. Times are means over the queries: `t_match_s` is for all references,
    `t_match_per_ref_s` for one. `u_encode` and `u_match` are the shares of all cores that were busy, 0..1 (5.1).
    `descriptor_bytes` and `fine_bytes` are the RAM and the disk of a place, as `profile` says them. Charges are for all
    queries, in Ah (5.7), from the battery pack; `ah_assumes` names board, pack and efficiency. `sequence`: how many
    queries were matched together. `known`: that of `MatchOptions`. `weights`: origin of the network's weights (None: no
    network). `pcu`: filled in by `compare`, since it depends on all techniques compared.
    """

    parameters: dict[str, int | float | str]
    accepted: int
    accepted_wrong: int
    accepted_elsewhere: int
    t_encode_s: float
    t_match_s: float
    t_match_per_ref_s: float
    descriptor_bytes: int
    fine_bytes: int
    u_encode: float
    u_match: float
    ah_total: float
    ah_assumes: str
    sequence: int = 1
    known: str | None = None
    discarded: int = 0
    weights: str | None = None
    pcu: float | None = None


def quietly(items: Iterable[Any], total: int, label: str) -> Iterable[Any]:
    return items


def evaluate(
    technique_name: str,
    dataset: Dataset,
    parameters: dict[str, Any] | None = None,
    options: MatchOptions = MatchOptions(),  # noqa: B008  it is frozen
    progress: Progress[Any] = quietly,
    gate: Gate | None = None,
) -> TechniqueResult:
    """Map the references of `dataset` in a temporary file, ask every query, and score the answers. `parameters` are
    those of the technique (None: its defaults). `gate` discards queries that are not memorable (None: none are); the
    map has all references, as in the thesis (3.3).

    Raises UsageError for an unknown technique or parameter, ImageError for an image that cannot be used, MapError if
    the temporary map cannot be written, and ModelError for a network that cannot be used or a query that fails.
    """
    technique = create(technique_name, parameters)
    return summary(technique, len(dataset.references), answered(technique, dataset, options, progress, gate), options)


def answered(
    technique: Technique,
    dataset: Dataset,
    options: MatchOptions,
    progress: Progress[Any] = quietly,
    gate: Gate | None = None,
) -> list[QueryAnswer]:
    """Map the references of `dataset` in a temporary file, ask every query, and return the judged answers. Raises
    UsageError where no query has what `options.known` asks for."""
    prior, tags = known_of(options.known, dataset, technique.spec, options.sequence)
    source, meter = open_source(str(dataset.ref_dir), live=False), own_meter()
    frames = progress(all_frames(source), source.total, f"{technique.spec.name}: references")
    with mapped(frames, technique, meter, dataset.ref_dir, progress) as (place_map, index):
        walk = Walk(technique, place_map, index, meter, options=options, gate=gate, prior=prior)
        walk.warm_up(dataset.queries[0].path)
        return list(answers(walk, dataset, progress, tags))


def own_meter() -> QueryMeter:
    """Return a meter that measures the stages of a query on this machine."""
    return meter_of(load_config(None), load_board("this"))


@contextmanager
def mapped(
    frames: Iterable[Frame],
    technique: Technique,
    meter: QueryMeter,
    images: Path | None = None,
    progress: Progress[Any] = quietly,
) -> Iterator[tuple[PlaceMap, PlaceIndex]]:
    """Context manager: make a temporary map as `make_map` does; gives the map, open to read, and an index with all its
    places."""
    with tempfile.TemporaryDirectory(prefix="edgevpr-eval-") as folder:
        path = Path(folder) / "references.gpkg"
        make_map(path, frames, technique, images, meter, progress)
        with opened(path, technique) as both:
            yield both


def make_map(
    path: Path,
    frames: Iterable[Frame],
    technique: Technique,
    images: Path | None,
    meter: QueryMeter | None = None,
    progress: Progress[Any] = quietly,
) -> None:
    """Map `frames` in the new file `path`, then refine and calibrate the map as `map build` does. `images` is the
    folder that the frames come from (None: the map is not calibrated); `meter` None: that of `own_meter`."""
    meter = meter or own_meter()

    def shown(items: Iterable[Any], total: int, label: str) -> Iterable[Any]:
        return progress(items, total, f"{technique.spec.name}: {label}")

    with PlaceMap.create(path, technique.spec) as place_map:
        build_map(frames, technique, place_map, meter)
        with suppress(UsageError):  # nothing to refine, or no SciPy: positions stay as they were recorded
            refine_map(place_map, technique, images, shown)
        if images:
            with suppress(UsageError):  # too few pictures to calibrate by: the shipped model of confidence applies
                calibrate_map(place_map, technique, load_config(None), FlownPictures(source=str(images)), shown)


@contextmanager
def opened(path: Path, technique: Technique) -> Iterator[tuple[PlaceMap, PlaceIndex]]:
    """Context manager: open the map file `path` to read; gives the map, and an index with all its places."""
    with PlaceMap.open(path) as place_map:
        yield place_map, load_index(place_map, technique, len(place_map) * bytes_per_place(technique.spec))


def compare(results: Iterable[TechniqueResult]) -> list[TechniqueResult]:
    """Return the results with the PCU (see `metrics.pcu`) filled in. It depends on the slowest encoder among them."""
    results = list(results)
    slowest_s = max((result.t_encode_s for result in results), default=0.0)
    return [
        replace(each, pcu=metrics.pcu(each.precision_at_100_recall, each.t_encode_s, slowest_s)) for each in results
    ]


def from_json(row: dict[str, Any]) -> TechniqueResult:
    """Return the result whose fields are in `row`, as read from JSON. Other keys of `row` are left out."""
    return TechniqueResult(**{each.name: row[each.name] for each in fields(TechniqueResult) if each.name in row})


def all_frames(source: Source) -> Iterator[Frame]:
    """Yield all frames of a folder or video. Raises ImageError for the first that cannot be used: figures without some
    images would mislead."""
    while not source.ended:
        if frame := source.read(timeout_s=1.0):
            yield frame


def summary(
    technique: Technique,
    references: int,
    answers: Sequence[QueryAnswer],
    options: MatchOptions = MatchOptions(),  # noqa: B008  it is frozen
) -> TechniqueResult:
    """Return the result of `technique`, without the PCU, from its answers to all queries, which were asked by
    `options`. `references` is the number of references."""
    queries = len(answers)
    scores = np.array([answer.score for answer in answers])
    ranks = np.array([answer.first_right for answer in answers])
    config = load_config(None)
    board, pack, efficiency = load_board("this"), parse_pack(config.battery.pack), config.battery.regulator_efficiency
    encoding = sum((answer.encoding for answer in answers), start=NO_COST)
    matching = sum((answer.matching for answer in answers), start=NO_COST)
    t_encode_s, t_match_s = encoding.wall_s / queries, matching.wall_s / queries
    u_encode, u_match = encoding.utilisation(board.cores), matching.utilisation(board.cores)
    query_j = stage_energy_j(board.idle_w, board.full_w, u_encode, t_encode_s)
    query_j += stage_energy_j(board.idle_w, board.full_w, u_match, t_match_s)

    return TechniqueResult(
        technique=labelled(technique.spec.name, technique.spec.form),
        weights=weights_of(technique.spec),
        parameters=technique.spec.parameters,
        queries=queries,
        references=references,
        **metrics.figures(scores, ranks),
        accepted=sum(answer.accepted for answer in answers),
        accepted_wrong=sum(answer.accepted_wrong for answer in answers),
        accepted_elsewhere=sum(answer.accepted_elsewhere for answer in answers),
        discarded=sum(answer.discarded for answer in answers),
        t_encode_s=t_encode_s,
        t_match_s=t_match_s,
        t_match_per_ref_s=t_match_s / references,
        descriptor_bytes=ram_bytes(technique.spec, length_of(technique.spec, options.sequence)),
        fine_bytes=disk_bytes(technique.spec),
        u_encode=u_encode,
        u_match=u_match,
        ah_total=queries_ah(queries, pack_ah(query_j, pack, efficiency)),
        sequence=length_of(technique.spec, options.sequence),
        known=options.known and ",".join(told_parts(options.known)),
        ah_assumes=(
            f"{board.title}, {board.idle_w:g} W idle and {board.full_w:g} W at full load ({board.source}), "
            f"pack {config.battery.pack}, regulator efficiency {efficiency:g}"
        ),
    )
