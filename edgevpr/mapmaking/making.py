"""Builds a complete map: makes places from pictures, then refines and calibrates the map (`finishing`). The command
`edgevpr map build` calls it."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from edgevpr.core.config import Config, SourceConfig
from edgevpr.core.contract import Technique
from edgevpr.core.errors import EdgevprError, ImageError, UsageError
from edgevpr.core.text import Progress
from edgevpr.core.types import Frame
from edgevpr.frames.level import STRAIGHT_DOWN
from edgevpr.frames.mask import OverlayMask, load_mask
from edgevpr.frames.source import Source, read_to_end
from edgevpr.mapmaking import advice
from edgevpr.mapmaking.finishing import finish_map, make_encoder
from edgevpr.mapmaking.headings import find_headings
from edgevpr.mapmaking.mapping import CoveredGround, MappingResult, PlaceSelector, build_map, measure_ground
from edgevpr.mapmaking.pictures import FlightPictures, OrthophotoGrid
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapfiles import parse_map_path, remove_map
from edgevpr.places.mapinfo import describe_map
from edgevpr.power.boards import load_board
from edgevpr.runtime.preflight.pick import make_camera_setting
from edgevpr.runtime.recognise.calibration import MapCalibration
from edgevpr.runtime.recognise.evidence import list_evidence_kinds
from edgevpr.runtime.recognise.levelling import read_camera_lens, read_mount
from edgevpr.runtime.recognise.opening import create_technique, make_technique, open_salience_gate, warn_of_mismatch

if TYPE_CHECKING:
    from edgevpr.mapmaking.orthophoto_source import OrthophotoSource
    from edgevpr.mapmaking.refine import Refinement

_log = logging.getLogger(__name__)
_DEFAULT_TECHNIQUE = "cohog"  # the most accurate on the image sets, with a confidence and without a network


@dataclass(frozen=True, slots=True, kw_only=True)
class MapPlan:
    """The map to make at `path` from `pictures`.

    `technique`: its name (None: that of the existing map, or else `cohog`). `parameters`: technique parameters by name.
    `append`: add places to the map if it exists. `refine`, `calibrate`: then also refine and calibrate it."""

    path: str
    pictures: FlightPictures | OrthophotoGrid
    technique: str | None = None
    parameters: dict[str, str]
    append: bool = False
    refine: bool = True
    calibrate: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class BuiltMap:
    """Result of `make_map`. `technique`: its name. `places`, `with_position`: number of places in the map, and of
    places with a position. `result`: counts of the frames read. `covered`: the ground that all places cover, by their
    recorded positions (None: too few). `refined`, `calibration`, `not_done`: see `finish_map`."""

    technique: str
    places: int
    with_position: int
    result: MappingResult
    covered: CoveredGround | None
    refined: "Refinement | None"
    calibration: MapCalibration | None
    not_done: tuple[str, ...] = ()


def make_map(plan: MapPlan, config: Config, on_error: Callable[[ImageError], None], progress: Progress) -> BuiltMap:
    """Make or continue the map that `plan` describes. `on_error` is called with the error of each picture that
    cannot be used. `progress` reports progress. Raises EdgevprError."""
    path, board, pictures = parse_map_path(plan.path), load_board("this"), plan.pictures
    source_config, salience = config.source, config.salience
    is_new = not (plan.append and path.exists())
    place_map = None if is_new else PlaceMap.open_for_writing(path)
    source: Source
    counts: dict[str, int] = {}
    if isinstance(pictures, FlightPictures):
        mask, lens = load_mask(source_config.mask), source_config.lens
        source, technique = _open_flight(plan, pictures, source_config, place_map, mask)
    else:
        mask, lens = None, None
        source, technique = orthophoto_source, _ = _open_orthophoto(plan, pictures, source_config.camera, place_map)
        orthophoto_source.announce_size(pictures.spacing_m, technique)
        counts = orthophoto_source.counts
    if place_map is None:
        place_map = PlaceMap.create(path, technique.spec)
        place_map.record_mask(mask.sha256 if mask else None)
        place_map.record_lens(lens)
    else:
        warn_of_mismatch(place_map, mask, lens)
    with place_map:
        try:
            frames: Iterator[Frame] = filter(None, progress(read_to_end(source, on_error), source.total, "mapping"))
            if isinstance(pictures, FlightPictures):
                will_calibrate = plan.calibrate and list_evidence_kinds(technique.spec)
                advice.warn_of_gaps(pictures, source.total, len(place_map) if will_calibrate else None)
                advice.suggest_lens(pictures, source_config, technique)
                advice.warn_of_display(pictures, mask, upright=not technique.spec.looks_down)
                if technique.spec.looks_down and (camera := read_camera_lens(source_config)):
                    frames = find_headings(frames, camera)
            else:
                place_map.add_attribution(pictures.attribution)
            encoder = make_encoder(source_config, pictures, technique)
            result = build_map(
                frames,
                replace(encoder, gate=open_salience_gate(salience, board.threads)),
                place_map,
                PlaceSelector(salience.gap_frames, salience.gap_m),
                on_error,
            )
        except EdgevprError:
            if is_new and not len(place_map):  # e.g. the disk is full; an empty file would block the next attempt
                remove_map(path)
            raise
        if ground := measure_ground(place_map):
            _log.info("%s", ground.describe(is_flown=isinstance(pictures, FlightPictures)))
        refined, calibration, not_done = finish_map(
            place_map, encoder, config.match, pictures, progress, refine=plan.refine, calibrate=plan.calibrate
        )
        info = describe_map(place_map)
        if info.one_way_deg is not None:
            _log.warning("%s", info.one_way_warning)
        return BuiltMap(
            technique=technique.spec.name,
            places=len(place_map),
            with_position=info.with_position,
            result=replace(result, **counts),
            covered=ground,
            refined=refined,
            calibration=calibration,
            not_done=not_done,
        )


def _open_flight(
    plan: MapPlan, pictures: FlightPictures, config: SourceConfig, place_map: PlaceMap | None, mask: OverlayMask | None
) -> tuple[Source, Technique]:
    """Open the pictures and create the technique. Raises UsageError if the camera looks straight down but `--camera` is
    missing, if a camera that should look straight down is tilted otherwise than recorded, or if pictures of several
    lenses are to be levelled with one."""
    settings, camera = plan.parameters, config.camera
    name = _choose_name(plan, place_map)
    if camera is None and place_map is None and "camera" not in settings and make_camera_setting(name, "nadir"):
        advice.require_forward_camera(pictures, mask)
    if camera:  # a technique without this setting rejects it
        settings = settings | {"camera": camera}
    technique = _make_technique(plan, place_map, name, settings)
    if technique.spec.looks_down:
        lens = read_camera_lens(config)
        if lens:
            advice.require_one_lens(pictures)
        if not config.gimbal and (lens or read_mount(config) == STRAIGHT_DOWN):
            advice.require_level_camera(pictures, lens)
    return pictures.open(upright=not technique.spec.looks_down), technique


def _open_orthophoto(
    plan: MapPlan, pictures: OrthophotoGrid, camera: str | None, place_map: PlaceMap | None
) -> tuple["OrthophotoSource", Technique]:
    """Open the orthophoto and create the technique. Raises UsageError for a camera other than nadir."""
    if camera not in (None, "nadir"):
        raise UsageError(f"--camera {camera}: an orthophoto is seen from above, so pass --camera nadir, or omit it.")
    name = _choose_name(plan, place_map)
    settings = plan.parameters | make_camera_setting(name, "nadir")
    return pictures.open(), _make_technique(plan, place_map, name, settings)


def _choose_name(plan: MapPlan, place_map: PlaceMap | None) -> str:
    """Return the technique: the requested one, else that of the map (None: there is no map yet), else the default."""
    return plan.technique or (_DEFAULT_TECHNIQUE if place_map is None else place_map.spec.name)


def _make_technique(plan: MapPlan, place_map: PlaceMap | None, name: str, settings: dict[str, str]) -> Technique:
    board = load_board("this")
    if place_map is not None:  # not just `if place_map`: a map without places is falsy
        return create_technique(place_map, plan.technique, settings, board)
    return make_technique(board.threads, name, settings)
