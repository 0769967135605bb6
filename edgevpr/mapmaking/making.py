"""Making of a complete map: places from pictures, then refinement of their positions, then calibration of the map's
confidence. This is the work of the commands `edgevpr map build`, `map refine` and `map calibrate`."""

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.core.config import Config
from edgevpr.core.contract import Technique
from edgevpr.core.errors import EdgevprError, ImageError, UsageError
from edgevpr.core.geodesy import Extent
from edgevpr.core.text import at_work
from edgevpr.core.types import Frame
from edgevpr.frames.level import STRAIGHT_DOWN
from edgevpr.frames.mask import Mask, load_mask
from edgevpr.frames.source import Source, open_source, read_to_end
from edgevpr.mapmaking import advice
from edgevpr.mapmaking.headings import find_headings, lacks_heading
from edgevpr.mapmaking.mapping import Covered, Gaps, MappingResult, build_map, measure_ground
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapfiles import map_path, remove
from edgevpr.places.mapinfo import describe_map
from edgevpr.power.boards import load_board
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.preflight.pick import camera_setting, pick_technique
from edgevpr.runtime.recognise.calibration import MapCalibration
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.evidence import list_evidence_kinds
from edgevpr.runtime.recognise.levelling import lens_of, make_levelling, read_mount
from edgevpr.runtime.recognise.opening import (
    create_technique,
    made_for,
    open_salience_gate,
    warn_of_other_pictures,
)

if TYPE_CHECKING:
    from edgevpr.mapmaking.cuttings import OrthophotoSource
    from edgevpr.mapmaking.refine import Refined

_log = logging.getLogger(__name__)
_OF_ORTHOPHOTOS = "cohog"

# Called with items, their number and a label; yields the items unchanged and shows the progress.
Shown = Callable[[Iterable[Any], int, str], Iterable[Any]]


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownPictures:
    """Pictures of a flight. `source`: a folder of images or a video. `positions`: their table of positions (None: the
    one that `open_source` finds). `rate_hz`: pictures taken per second of a video (None: every frame)."""

    source: str
    positions: Path | None = None
    rate_hz: float | None = None

    def open(self, only: Collection[str] | None = None) -> Source:
        """Open the source. Only pictures whose names are in `only` are read (None: all)."""
        step_s = 1 / self.rate_hz if self.rate_hz else None
        return open_source(self.source, step_s=step_s, positions=self.positions, live=False, only=only)

    @property
    def folder(self) -> Path | None:
        """The folder of images; None for a video."""
        return Path(self.source) if Path(self.source).is_dir() else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Cuttings:
    """Pictures that are cut from an orthophoto, at the places of a grid.

    `orthophoto`: see `Orthophoto`. `footprint_m`: ground length of a picture's side, or several, each of which gives a
    picture of every place. `spacing_m`: distance between neighbouring places. `area`: file or circle that limits the
    places, see `missions.read_area` (None: the whole orthophoto). `attribution`: the owner's words, which a map keeps
    (None: none are asked for). `tile_deg`: the bounding box of the tile that the places are in, or not more than
    `margin_m` metres beside (None: all)."""

    orthophoto: str
    footprint_m: float | Sequence[float]
    spacing_m: float
    area: str | None = None
    attribution: str | None = None
    tile_deg: Extent | None = None
    margin_m: float = 0.0

    def open(self, only: Collection[str] | None = None) -> "OrthophotoSource":
        """Open the orthophoto and choose the places. Only pictures whose names are in `only` are cut (None: all).
        Raises SourceError if it cannot be opened, and UsageError if grid and area do not fit it."""
        from edgevpr.mapmaking.cuttings import open_cuttings  # loads GDAL, or raises if it is missing

        return open_cuttings(self, only)

    def extent_deg(self) -> Extent:
        """Return the bounding box of the ground that is cut: (south, west, north, east) in degrees, longitudes perhaps
        beyond the date line. Raises as `open` does."""
        from edgevpr.mapmaking.cuttings import extent_of_cuttings

        return extent_of_cuttings(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapOrder:
    """The map to be made at `path` from `pictures`.

    `technique`: its name (None: chosen for `board`, the board that will fly). `parameters`: of the technique, by name.
    `append`: add places to the map if it exists. `refine`, `calibrate`: also refine the map, and calibrate it, after
    the places are made."""

    path: str
    pictures: FlownPictures | Cuttings
    technique: str | None = None
    parameters: dict[str, str]
    board: str = "this"
    append: bool = False
    refine: bool = True
    calibrate: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class MadeMap:
    """Result of `make_map`. `technique`: its name. `places`, `with_position`: number of places in the map, and of
    those that have a position. `result`: counts of the frames read. `covered`: the ground of all places, as recorded
    (None: too few positions). `refined`, `calibration`: results of refining and calibrating (None: not done).
    `not_done`: sentences on which of them was to be done and could not be, and why."""

    technique: str
    places: int
    with_position: int
    result: MappingResult
    covered: Covered | None
    refined: "Refined | None"
    calibration: MapCalibration | None
    not_done: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FinishedMap:
    """Result of `finish_map`: the fields of the same names of a `MadeMap`."""

    refined: "Refined | None"
    calibration: MapCalibration | None
    not_done: tuple[str, ...]


def make_map(order: MapOrder, config: Config, unusable: Callable[[ImageError], None], shown: Shown) -> MadeMap:
    """Make the map that `order` describes, or continue it. `unusable` is called with an error for each picture that
    cannot be used. `shown` shows progress. Raises EdgevprError."""
    path, here, pictures = map_path(order.path), load_board("this"), order.pictures
    is_new = not (order.append and path.exists())
    place_map = None if is_new else PlaceMap.open_for_adding(path)
    source: Source
    counts: dict[str, int] = {}
    if isinstance(pictures, FlownPictures):
        mask, lens = load_mask(config.source.mask), config.source.lens
        source, technique = _open_flown(order, pictures, config, place_map, mask)
    else:
        mask, lens = None, None
        source, technique = cuttings, _ = _open_cuttings(order, pictures, config, place_map)
        cuttings.begin(pictures.spacing_m, technique, shown)
        counts = cuttings.counts
    if place_map is None:
        place_map = PlaceMap.create(path, technique.spec)
        place_map.record_mask(mask.sha256 if mask else None)
        place_map.record_lens(lens)
    else:
        warn_of_other_pictures(place_map, mask, lens)
    with place_map:
        try:
            if isinstance(pictures, FlownPictures):
                is_calibrated = order.calibrate and list_evidence_kinds(technique.spec)
                advice.warn_of_gaps(pictures, source.total, len(place_map) if is_calibrated else None)
                advice.suggest_lens(pictures, config.source, technique)
                advice.warn_of_display(pictures, mask)
            else:
                place_map.add_attribution(pictures.attribution)
            frames: Iterator[Frame] = filter(None, shown(read_to_end(source, unusable), source.total, "mapping"))
            if technique.spec.looks_down and isinstance(pictures, FlownPictures) and (camera := lens_of(config.source)):
                frames = find_headings(frames, camera)
            result = build_map(
                frames,
                replace(
                    encoder_of(config, pictures, technique), gate=open_salience_gate(config.salience, here.threads)
                ),
                place_map,
                Gaps(config.salience.gap_frames, config.salience.gap_m),
                unusable,
            )
        except EdgevprError:
            if is_new and not len(place_map):  # such as a full disk: an empty file would block the next attempt
                remove(path)
            raise
        if covered := measure_ground(place_map):
            _log.info("%s", covered.described(is_flown=isinstance(pictures, FlownPictures)))
        finished = finish_map(
            place_map, technique, config, pictures, shown, refine=order.refine, calibrate=order.calibrate
        )
        info = describe_map(place_map)
        if info.one_way_deg is not None:
            _log.warning("%s", info.described_way)
        return MadeMap(
            technique=technique.spec.name,
            places=len(place_map),
            with_position=info.with_position,
            result=replace(result, **counts),
            covered=covered,
            refined=finished.refined,
            calibration=finished.calibration,
            not_done=finished.not_done,
        )


def finish_map(
    place_map: PlaceMap,
    technique: Technique,
    config: Config,
    pictures: FlownPictures | Cuttings | None,
    shown: Shown,
    refine: bool = True,
    calibrate: bool = True,
) -> FinishedMap:
    """Refine and calibrate an open map as far as its technique and its `pictures` (None: not at hand, so that it is not
    calibrated) allow it. What fails is logged and said in the result: a map is of use without."""
    refined, calibration, not_done = None, None, []
    if refine and technique.spec.looks_down and not isinstance(pictures, Cuttings):
        try:
            refined = refine_map(place_map, technique, pictures.folder if pictures else None, shown)
        except EdgevprError as error:
            not_done.append(f"the map is not refined: {error}")
    if calibrate and pictures and list_evidence_kinds(technique.spec):
        try:
            calibration = calibrate_map(place_map, technique, config, pictures, shown)
        except EdgevprError as error:
            not_done.append(f"the map is not calibrated: {error}")
    for sentence in not_done:
        _log.warning("%s", sentence)
    return FinishedMap(refined, calibration, tuple(not_done))


def refine_map(place_map: PlaceMap, technique: Technique, images: str | Path | None, shown: Shown) -> "Refined":
    """Refine the positions of an open map (see `refine`). `images` is the folder of its pictures (None: not at hand).
    Raises UsageError if the map's technique does not allow it, or SciPy is missing."""
    if not technique.spec.looks_down:
        raise UsageError(
            f"{place_map.path} is of {technique.spec.name}, and not of a camera that looks straight down: only `cohog` "
            "with `--camera nadir` can be refined."
        )
    with _needing_scipy():
        from edgevpr.mapmaking.refine import refine
    refined = refine(place_map, technique, lambda pairs, total: shown(pairs, total, "refining"), images)
    if refined.is_mirrored:
        _log.warning(
            "lat and lon may be swapped, or the sign of one lost (south and west are negative): the pictures fit the "
            "mirror image of their positions, so no place of %s is refined: check the columns, and make the map again",
            place_map.path,
        )
    return refined


def calibrate_map(
    place_map: PlaceMap, technique: Technique, config: Config, pictures: FlownPictures | Cuttings, shown: Shown
) -> MapCalibration:
    """Calibrate the confidence of an open map with the pictures that it was made from, as far as they can be read (see
    `calibrate`). Raises UsageError if the map cannot be calibrated, or SciPy is missing."""
    with _needing_scipy():
        from edgevpr.mapmaking.calibrate import calibrate

    lens = lens_of(config.source) if technique.spec.looks_down and isinstance(pictures, FlownPictures) else None

    def read(names: Collection[str] | None) -> Iterator[Frame]:
        yield from filter(None, read_to_end(pictures.open(names), lambda error: None))

    def frames(names: Collection[str]) -> Iterator[Frame]:
        first = next(read(names), None)
        if lens is None or first is None or not lacks_heading(first, lens):
            yield from read(names)
        else:  # the images between show the motion
            yield from (frame for frame in find_headings(read(None), lens) if frame.name in names)

    return calibrate(
        encoder_of(config, pictures, technique),
        place_map,
        config.match,
        QueryMeter(load_board("this")),
        frames,
        lambda asked, total: shown(asked, total, "calibrating"),
    )


def _open_flown(
    order: MapOrder, pictures: FlownPictures, config: Config, place_map: PlaceMap | None, mask: Mask | None
) -> tuple[Source, Technique]:
    """Open the pictures, and make the technique: the one asked for, else that of the map (`place_map` None: there is no
    map yet), else the best for the board. Raises UsageError if the camera looks down, and nobody has said so, and for
    one that is tilted by angles that are not recorded."""
    source, settings, camera = pictures.open(), order.parameters, config.source.camera
    name = order.technique or (place_map.spec.name if place_map is not None else None)
    asks_camera = camera is None and place_map is None and "camera" not in settings
    if asks_camera and (not name or camera_setting(name, "nadir")):
        advice.require_ahead(pictures, mask)
    if name is None:
        with at_work("choosing a technique"):
            name = pick_technique(order.board, source.total or 1, camera)
        settings = settings | camera_setting(name, camera)
    elif camera:  # a technique that knows no camera refuses one that was asked for
        settings = settings | {"camera": camera}
    technique = _make_technique(order, place_map, name, settings)
    if technique.spec.looks_down and not config.source.gimbal and read_mount(config.source) == STRAIGHT_DOWN:
        advice.require_level(pictures, config.source.fov_deg)
    return source, technique


def _open_cuttings(
    order: MapOrder, pictures: Cuttings, config: Config, place_map: PlaceMap | None
) -> tuple["OrthophotoSource", Technique]:
    """Open the orthophoto, and make the technique: the one asked for, else that of the map (`place_map` None: there is
    no map yet), else `cohog`. Raises UsageError for another camera, and for tiles whose owner is not named."""
    if "://" in str(pictures.orthophoto) and not pictures.attribution:
        raise UsageError("Tiles of an address have an owner: give --attribution TEXT, as its terms ask for.")
    if (camera := config.source.camera) not in (None, "nadir"):
        raise UsageError(f"--camera {camera}: an orthophoto shows the ground from above: give nadir, or leave it out.")
    name = order.technique or (place_map.spec.name if place_map is not None else _OF_ORTHOPHOTOS)
    settings = order.parameters | camera_setting(name, "nadir")
    return pictures.open(), _make_technique(order, place_map, name, settings)


def _make_technique(order: MapOrder, place_map: PlaceMap | None, name: str, settings: dict[str, str]) -> Technique:
    here = load_board("this")
    if place_map is not None:  # one without places is false
        return create_technique(place_map, order.technique, settings, here)
    return made_for(here.threads, name, settings)


def encoder_of(config: Config, pictures: FlownPictures | Cuttings, technique: Technique) -> FrameEncoder:
    """Return the encoder of places: with mask and levelling, which pictures cut from an orthophoto do not need."""
    if isinstance(pictures, Cuttings):
        return FrameEncoder(technique=technique)
    levelling = make_levelling(config.source, technique, below=True)
    return FrameEncoder(technique=technique, mask=load_mask(config.source.mask), levelling=levelling)


@contextmanager
def _needing_scipy() -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as error:
        raise UsageError(
            f"Refining and calibrating a map need SciPy ({error}): install it on the machine that builds maps, with "
            "`pip install scipy`, and run `edgevpr map refine` and `edgevpr map calibrate`."
        ) from error
