"""Maps of image sets and recognisers that match in them, for the benchmarks."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import base
import numpy as np

from edgevpr.core.config import Config, load_config
from edgevpr.core.contract import Technique
from edgevpr.core.types import Frame
from edgevpr.frames.images import read_image
from edgevpr.frames.source import open_source, read_to_end
from edgevpr.lab.evaluate.dataset import Dataset, load_dataset
from edgevpr.lab.evaluate.evaluate import open_temporary_map
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.sequence import SequenceSearch
from edgevpr.power.boards import load_board
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.calibration import read_calibration_for
from edgevpr.runtime.recognise.decide import Matcher, MatchSettings
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.judge import AcceptRule, make_accept_rule
from edgevpr.runtime.recognise.levelling import Levelling
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.techniques import create


def load_matched_set(folder: Path) -> Dataset:
    """Read a set with only those queries whose place is in the map; other benchmarks measure foreign queries."""
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    return replace(dataset, queries=tuple(query for query in dataset.queries if query.correct))


def make_config(**keys: object) -> Config:
    """Return the default configuration with these keys set, for example `map`."""
    return load_config(None, keys)


def make_meter() -> QueryMeter:
    return QueryMeter(load_board("this"))


def read_folder_frames(folder: Path) -> Iterator[Frame]:
    """Yield the pictures of a folder as frames, with their positions."""
    return filter(None, read_to_end(open_source(str(folder), live=False)))


def make_frame(image: np.ndarray | Path, name: str | None = None, t_s: float = 0.0) -> Frame:
    """Return a frame of a picture, given as an array or as a file."""
    if isinstance(image, Path):
        return Frame(image=read_image(image), name=name or image.name, t_mono_s=t_s)
    return Frame(image=image, name=name or "", t_mono_s=t_s)


def make_cohog(camera: str) -> Technique:
    return create("cohog", {"camera": camera})


@contextmanager
def make_map(
    folder: Path, technique: Technique | None = None, images: Path | None = None
) -> Iterator[tuple[PlaceMap, PlaceIndex, Technique]]:
    """Map the references of a set with `technique` (None: `cohog`) and yield map, index and technique. If `images`
    names the folder of these pictures, the map is refined and calibrated as by `map build`."""
    technique = technique or make_cohog(base.infer_camera(folder.name))
    with open_temporary_map(read_folder_frames(folder / "ref"), technique, images) as (place_map, index, _):
        yield place_map, index, technique


def make_walk(
    place_map: PlaceMap,
    index: PlaceIndex,
    technique: Technique,
    *,
    rule: AcceptRule | None = None,
    search: SequenceSearch | None = None,
    min_accuracy_m: float = 1.0,
    all_evidence: bool = False,
    levelling: Levelling | None = None,
    **more: Any,
) -> Recogniser:
    """Return a recogniser for a map, with the technique's number of candidates and `rule` (None: the rule of the map).
    `more` are other arguments of `Recogniser`."""
    rule = rule or make_accept_rule(technique, make_config().match, 1, read_calibration_for(place_map))
    settings = MatchSettings(candidates=technique.candidates, all_evidence=all_evidence, min_accuracy_m=min_accuracy_m)
    encoder = FrameEncoder(technique=technique, levelling=levelling)
    return Recogniser(encoder, place_map, Matcher(index, rule, search), make_meter(), settings=settings, **more)


def list_ranked_names(event: Recognition, names: list[str] | tuple[str, ...]) -> list[str]:
    """Return the names of the places in the ranking of a query, best first; `names` are those of the slots. Raises
    EdgevprError if the query failed."""
    if event.failed:
        raise base.EdgevprError(str(event.reason))
    return [names[slot] for slot in event.ranking.slots] if event.ranking else []


def read_names(place_map: PlaceMap, index: PlaceIndex) -> list[str]:
    """Return the name of each place's picture, in the order of the slots of the index."""
    names = {place.place_id: place.source_image for place in place_map.read_places()}
    return [names[place_id] for place_id in index.place_ids.tolist()]


@contextmanager
def open_walk(places: Iterable[Path], name: str, looks_down: bool) -> Iterator[Recogniser]:
    """Map images with the technique `name`, and yield a recogniser for that map that accepts no match."""
    technique = create(name, {"camera": "nadir"} if looks_down and name == "cohog" else {})
    with open_temporary_map(map(make_frame, places), technique) as (place_map, index, _):
        yield make_walk(place_map, index, technique, rule=AcceptRule(min_score=1.0, min_margin=1.0, neighbour_m=0.0))
