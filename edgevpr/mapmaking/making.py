"""Making of a complete map: places from pictures, then refinement of their positions, then calibration of the map's
confidence. This is the work of the commands `edgevpr map build`, `map refine` and `map calibrate`."""

import logging
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.core.config import Config
from edgevpr.core.contract import Technique
from edgevpr.core.errors import EdgevprError, ImageError, UsageError
from edgevpr.core.text import at_work
from edgevpr.core.types import Frame
from edgevpr.frames.mask import Mask, mask_of
from edgevpr.frames.source import Source, open_source, read_to_end
from edgevpr.mapmaking.beforehand import require_ahead, say_what_lens, say_what_will_lack
from edgevpr.mapmaking.display import say_what_stands_still
from edgevpr.mapmaking.mapping import Covered, Gaps, MappingResult, build_map, covered_by
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapfiles import map_path, remove
from edgevpr.places.mapinfo import info_of
from edgevpr.power.boards import load_board
from edgevpr.runtime.preflight.pick import camera_setting, picked_technique
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.evidence import MapCalibration, kinds_of
from edgevpr.runtime.recognise.levelling import levelling_of
from edgevpr.runtime.recognise.opening import gate_of, made_for, meter_of, technique_of, warn_of_other_pictures

if TYPE_CHECKING:
    from edgevpr.mapmaking.cuttings import OrthophotoSource
    from edgevpr.mapmaking.missions import Area
    from edgevpr.mapmaking.orthophoto import Orthophoto
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Cuttings:
    """Pictures that are cut from an orthophoto, at the places of a grid.

    `orthophoto`: see `Orthophoto`. `footprint_m`: ground length of a picture's side, or several, each of which gives a
    picture of every place. `spacing_m`: distance between neighbouring places. `area`: file or circle that limits the
    places, see `missions.read_area` (None: the whole orthophoto). `attribution`: the owner's words, which a map keeps
    (None: none are asked for). `tile`: the quad key of the tile that the places are in, or not more than `margin_m`
    metres beside (None: all)."""

    orthophoto: str
    footprint_m: float | Sequence[float]
    spacing_m: float
    area: str | None = None
    attribution: str | None = None
    tile: str | None = None
    margin_m: float = 0.0

    def open(self, only: Collection[str] | None = None) -> "OrthophotoSource":
        """Open the orthophoto and choose the places. Only pictures whose names are in `only` are cut (None: all).
        Raises SourceError if it cannot be opened, and UsageError if grid and area do not fit it."""
        from edgevpr.core.quadkeys import extent_around, ring_around
        from edgevpr.mapmaking.cuttings import OrthophotoSource, lattice_of, require_sharp, within
        from edgevpr.mapmaking.missions import Area, read_area

        area = Area(((ring_around(extent_around(self.tile, self.margin_m)),),), ()) if self.tile else None
        area = read_area(self.area) if self.area else area
        orthophoto = self._photo(area)
        lattices = [lattice_of(orthophoto, each_m, self.spacing_m, area) for each_m in self._footprints_m]
        require_sharp(orthophoto, self._footprints_m[0])
        if self.tile:
            lattices = [within(lattice, self.tile, self.margin_m) for lattice in lattices]
        # Seams are those of the whole raster, and to try a place takes longer than to map it.
        return OrthophotoSource(orthophoto, lattices, time.monotonic, only=only, tries_seams=self.tile is None)

    @property
    def _footprints_m(self) -> list[float]:
        return sorted(set(self.footprint_m) if isinstance(self.footprint_m, Sequence) else {self.footprint_m})

    def _photo(self, area: "Area | None") -> "Orthophoto":
        from edgevpr.mapmaking.orthophoto import Orthophoto  # loads GDAL, or raises if it is missing
        from edgevpr.mapmaking.tiles import ground_of

        return Orthophoto(self.orthophoto, ground_of(area.points, self._footprints_m[-1]) if area else None)

    def extent_deg(self) -> tuple[float, float, float, float]:
        """Return the bounding box of the ground that is cut: (south, west, north, east) in degrees, longitudes perhaps
        beyond the date line. Raises as `open` does."""
        from edgevpr.mapmaking.missions import read_area
        from edgevpr.mapmaking.tiles import ground_of

        area = read_area(self.area) if self.area else None
        orthophoto = self._photo(area)
        orthophoto.close()
        return ground_of(area.points, self._footprints_m[-1]).extent_deg if area else orthophoto.extent_deg


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
    (None: too few positions). `refined`, `calibration`: results of refining and calibrating (None: not done)."""

    technique: str
    places: int
    with_position: int
    result: MappingResult
    covered: Covered | None
    refined: "Refined | None"
    calibration: MapCalibration | None


def make_map(order: MapOrder, config: Config, unusable: Callable[[ImageError], None], shown: Shown) -> MadeMap:
    """Make the map that `order` describes, or continue it. `unusable` is called with an error for each picture that
    cannot be used. `shown` shows progress. Raises EdgevprError."""
    path, here, pictures = map_path(order.path), load_board("this"), order.pictures
    is_new = not (order.append and path.exists())
    if isinstance(pictures, Cuttings) and "://" in str(pictures.orthophoto) and not pictures.attribution:
        raise UsageError("Tiles of an address have an owner: give --attribution TEXT, as its terms ask for.")
    mask, lens = (None, None) if isinstance(pictures, Cuttings) else (mask_of(config.source.mask), config.source.lens)
    if is_new:
        source, technique = _opened(order, config, None, mask)
        place_map = PlaceMap.create(path, technique.spec)
        place_map.record_mask(mask.sha256 if mask else None)
        place_map.record_lens(lens)
    else:
        place_map = PlaceMap.open_for_adding(path)
        source, technique = _opened(order, config, place_map, mask)
        warn_of_other_pictures(place_map, mask, lens)
    with place_map:
        try:
            if isinstance(pictures, FlownPictures):
                _say_beforehand(pictures, config, technique, source.total, len(place_map) if order.calibrate else None)
                say_what_stands_still(pictures.source, mask)
            else:
                place_map.add_attribution(pictures.attribution)
                _say_and_fetch(source, pictures.spacing_m, technique, shown)
            result = build_map(
                (frame for frame in shown(read_to_end(source, unusable), source.total, "mapping") if frame),
                replace(encoder_of(config, pictures, technique), gate=gate_of(config.salience, here.threads)),
                place_map,
                Gaps(config.salience.gap_frames, config.salience.gap_m),
                unusable,
            )
            for name in ("without_data", "white", "seams", "tried_for_seams"):
                setattr(result, name, getattr(source, name, 0))
        except EdgevprError:
            if is_new and not len(place_map):  # such as a full disk: an empty file would block the next attempt
                remove(path)
            raise
        if covered := covered_by(place_map):
            _log.info("%s", covered.described(is_flown=isinstance(pictures, FlownPictures)))
        refined, calibration = None, None
        if order.refine and technique.spec.looks_down and isinstance(pictures, FlownPictures):
            images = pictures.source if Path(pictures.source).is_dir() else None
            with _if_possible("refined"):
                refined = refine_map(place_map, technique, images, shown)
        if order.calibrate and kinds_of(technique.spec):
            with _if_possible("calibrated"):
                calibration = calibrate_map(place_map, technique, config, pictures, shown)
        return MadeMap(
            technique=technique.spec.name,
            places=len(place_map),
            with_position=info_of(place_map).with_position,
            result=result,
            covered=covered,
            refined=refined,
            calibration=calibration,
        )


def _say_and_fetch(source: Source, spacing_m: float, technique: Technique, shown: Shown) -> None:
    """Say how much will be cut, and fetch the tiles for it: so an address that refuses them leaves no half map."""
    from edgevpr.mapmaking.cuttings import OrthophotoSource

    assert isinstance(source, OrthophotoSource)  # opened by `Cuttings`
    if _log.isEnabledFor(logging.INFO):  # it takes half a second
        _log.info("%s", source.forecast(spacing_m, technique))
    if to_fetch := source.to_fetch():
        count, steps = to_fetch
        for _ in shown(steps, count, "fetching tiles"):
            pass


def _say_beforehand(
    pictures: FlownPictures, config: Config, technique: Technique, total: int, places: int | None
) -> None:
    """Say what the map will lack; `places` are those in a map that is to be calibrated."""
    is_sure = kinds_of(technique.spec)
    say_what_will_lack(pictures.source, pictures.positions, pictures.rate_hz, total, places if is_sure else None)
    is_down = technique.spec.parameters.get("camera") == "nadir"
    if is_down and config.source.fov_deg is None and config.source.lens is None and Path(pictures.source).is_dir():
        say_what_lens(Path(pictures.source))


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

    def frames(names: Collection[str]) -> Iterator[Frame]:
        yield from filter(None, read_to_end(pictures.open(names), lambda error: None))

    return calibrate(
        encoder_of(config, pictures, technique),
        place_map,
        config.match,
        meter_of(config, load_board("this")),
        frames,
        lambda asked, total: shown(asked, total, "calibrating"),
    )


def _opened(order: MapOrder, config: Config, place_map: PlaceMap | None, mask: Mask | None) -> tuple[Source, Technique]:
    """Open the pictures, and make the technique: the one asked for, else that of the map (`place_map` None: there is no
    map yet), else the best for the board. Raises UsageError if the camera looks down, and nobody has said so."""
    is_cut, camera, here = isinstance(order.pictures, Cuttings), config.source.camera, load_board("this")
    if is_cut and camera not in (None, "nadir"):
        raise UsageError(f"--camera {camera}: an orthophoto shows the ground from above: give nadir, or leave it out.")
    camera = "nadir" if is_cut else camera
    source: Source = order.pictures.open()
    name = order.technique or (place_map.spec.name if place_map is not None else _OF_ORTHOPHOTOS if is_cut else None)
    asks_camera = camera is None and place_map is None and "camera" not in order.parameters
    if isinstance(order.pictures, FlownPictures) and asks_camera and (not name or camera_setting(name, "nadir")):
        require_ahead(order.pictures.source, mask)
    if name is None or is_cut:
        with at_work("choosing a technique"):
            name = name or picked_technique(order.board, source.total or 1, camera)
        settings = order.parameters | camera_setting(name, camera)
    else:  # a technique that knows no camera refuses one that was asked for
        settings = order.parameters | ({"camera": camera} if camera else {})
    if place_map is not None:  # one without places is false
        return source, technique_of(place_map, order.technique, settings, here)
    return source, made_for(here.threads, name, settings)


def encoder_of(config: Config, pictures: FlownPictures | Cuttings, technique: Technique) -> FrameEncoder:
    """Return the encoder of places: with mask and levelling, which pictures cut from an orthophoto do not need."""
    if isinstance(pictures, Cuttings):
        return FrameEncoder(technique=technique)
    levelling = levelling_of(config.source, technique, below=True)
    return FrameEncoder(technique=technique, mask=mask_of(config.source.mask), levelling=levelling)


@contextmanager
def _if_possible(what: str) -> Iterator[None]:
    """Run the body of `with` as an optional step: if it raises EdgevprError, only log a warning that the map is not
    `what` (such as "refined")."""
    try:
        yield
    except EdgevprError as error:
        _log.warning("the map is not %s: %s", what, error)


@contextmanager
def _needing_scipy() -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as error:
        raise UsageError(
            f"Refining and calibrating a map need SciPy ({error}): install it on the machine that builds maps, with "
            "`pip install scipy`, and run `edgevpr map refine` and `edgevpr map calibrate`."
        ) from error
