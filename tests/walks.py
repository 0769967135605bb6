"""Small maps, and recognisers over them, for tests of the walk of a frame."""

from collections.abc import Iterable
from pathlib import Path

from fakes import FakeClock

from edgevpr.core.config import load_config
from edgevpr.core.contract import Technique
from edgevpr.core.types import Frame
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.index import load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.sequence import SequenceSearch
from edgevpr.power.boards import load_board
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.decide import Matcher, MatchSettings
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.judge import AcceptRule, make_accept_rule
from edgevpr.runtime.recognise.recogniser import Recogniser

USUAL_SETTINGS = MatchSettings(candidates=50)


def query_meter(clock: FakeClock | None = None) -> QueryMeter:
    """A meter by a clock that moves when told to."""
    clock = clock or FakeClock()
    return QueryMeter(load_board("rpi-4b"), wall_clock=clock, cpu_clock=clock.clock.process_cpu_s)


def make_map(path: Path, technique: Technique, frames: Iterable[Frame], **encoder) -> Path:
    """Make a map of frames; return its path. `encoder` has other parts of a `FrameEncoder`."""
    with PlaceMap.create(path, technique.spec) as place_map:
        build_map(frames, FrameEncoder(technique=technique, **encoder), place_map)
    return path


def walk_over(
    place_map: PlaceMap,
    technique: Technique,
    rule: AcceptRule | None = None,
    search: SequenceSearch | None = None,
    *,
    clock: FakeClock | None = None,
    settings: MatchSettings = USUAL_SETTINGS,
    encoder: dict | None = None,
    **more,
) -> Recogniser:
    """A recogniser over an open map, by the usual rule where none is given; `encoder` as in `map_of`."""
    rule = rule or make_accept_rule(technique, load_config(None).match)
    matcher = Matcher(load_index(place_map, technique, 10**7), rule, search)
    of_frames = FrameEncoder(technique=technique, **(encoder or {}))
    return Recogniser(of_frames, place_map, matcher, query_meter(clock), settings=settings, **more)
