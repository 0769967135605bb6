"""The work of one worker of a fleet: a tile is mapped as `map build` maps it.

It depends on its task alone, and a map appears in the folder as a whole: a task can be done again, by another worker
or by the next run. A tile whose map was made of the same is left as it is."""

import hashlib
import logging
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2

from edgevpr import __version__
from edgevpr.core.config import Config
from edgevpr.core.errors import EdgevprError, ImageError
from edgevpr.core.geodesy import Extent, is_in_extent
from edgevpr.fleet.grid import Tile
from edgevpr.fleet.photos import Photos, content_in, gather
from edgevpr.mapmaking.cuttings import NoPlaceError
from edgevpr.mapmaking.making import Cuttings, FlownPictures, MapOrder, make_map
from edgevpr.places.examine import Wanted, positions_in, select
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.preflight.pick import camera_setting
from edgevpr.runtime.recognise.calibration import read_calibration_for

TECHNIQUE = "cohog"
MARGIN_M = 150.0  # around a tile: pictures from which its own are refined, and told from


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetOrder:
    """The maps to be made in the folder `out`. `config`: of the flights. `camera`: the way it looks, nadir or forward.
    `refine`, `calibrate`: see `MapOrder`. `version`: of the edgevpr that asks for them."""

    out: Path
    config: Config
    camera: str
    refine: bool = True
    calibrate: bool = True
    version: str = __version__


@dataclass(frozen=True, slots=True, kw_only=True)
class TileTask:
    """A `tile` to be mapped, and what of: `cuttings` of an orthophoto, or `photos`, in the tile and around it, those
    `inside` by their paths."""

    tile: Tile
    cuttings: Cuttings | None = None
    photos: Photos = field(default_factory=dict)
    inside: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True, kw_only=True)
class DoneTile:
    """The end of the task for the tile `name`. `places`: their number in its map (0: it has none). `is_calibrated`: its
    map is. `is_new`: its map was made now. `unusable`: sentences about pictures that could not be used. `problem`:
    why it could not be mapped."""

    name: str
    places: int = 0
    is_calibrated: bool = False
    is_new: bool = False
    unusable: tuple[str, ...] = ()
    problem: str | None = None


def build_tile(task: TileTask, order: FleetOrder) -> DoneTile:
    """Map one tile; a worker runs this."""
    if order.version != __version__:  # a worker that has come later
        problem = f"a worker has edgevpr {__version__}, and {order.version} asks: install the same on all machines"
        return DoneTile(name=task.tile.name, problem=problem)
    log = logging.getLogger("edgevpr")
    level_before = log.level
    log.setLevel(logging.ERROR)  # the command says what the tiles lack
    cv2.setNumThreads(1)  # there is a worker for every core
    try:
        with tempfile.TemporaryDirectory(prefix="edgevpr-tile-") as scratch:
            return _built(task, order, Path(scratch))
    except NoPlaceError:
        return DoneTile(name=task.tile.name)
    except EdgevprError as error:  # as text: not every error can travel
        return DoneTile(name=task.tile.name, problem=str(error))
    finally:
        log.setLevel(level_before)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Inputs:
    """All that a tile is mapped from: the `pictures`, the hash of their content and of the settings, and sentences
    about those of the tile that cannot be used. `is_named` returns True for the name of one of them, and `inside` the
    places that lie in the tile, and not only near it. `paths`: those of photographs, by name."""

    pictures: Cuttings | FlownPictures
    sha256: str
    is_named: Callable[[str], bool]
    inside: Wanted
    paths: Mapping[str, str] = field(default_factory=dict)
    unusable: list[str] = field(default_factory=list)


def _of_orthophoto(order: FleetOrder, tile_deg: Extent, cuttings: Cuttings) -> _Inputs:
    """Open the ground of a tile. Raises NoPlaceError if it has none."""
    cuttings = replace(cuttings, margin_m=MARGIN_M if order.calibrate else 0.0)
    said = repr(replace(cuttings, orthophoto="", area=None))
    with closing(cuttings.open()) as source:
        ground = [hashlib.sha256(each).hexdigest() for each in source.ground(cuttings.spacing_m)]
    of_this = f"{source.short_name}_"

    def inside(place_map: PlaceMap) -> list[int]:
        place_ids, lat_deg, lon_deg = positions_in(place_map)
        there: list[int] = place_ids[is_in_extent(tile_deg, lat_deg, lon_deg)].tolist()
        return there

    return _Inputs(
        pictures=cuttings,
        sha256=_hash_of(order, [said, *ground]),
        is_named=lambda name: name.startswith(of_this),
        inside=inside,
    )


def _of_photos(order: FleetOrder, task: TileTask, folder: Path) -> _Inputs:
    """Bring the photographs of a tile into a folder. Raises NoPlaceError if none of the tile can be used."""
    folder.mkdir()
    needs_near = order.refine or order.calibrate
    found = gather({path: tag for path, tag in task.photos.items() if needs_near or path in task.inside}, folder)
    contents, paths = set(map(content_in, found.paths)), found.paths
    return _Inputs(
        pictures=FlownPictures(source=str(folder)),
        sha256=_hash_of(order, sorted(found.contents)),
        is_named=lambda name: content_in(name) in contents,
        inside=lambda place_map: [
            place.place_id for place in place_map.places() if paths[place.source_image] in task.inside
        ],
        paths=paths,
        unusable=[text for path, text in found.unusable.items() if path in task.inside],
    )


def _built(task: TileTask, order: FleetOrder, scratch: Path) -> DoneTile:
    name, folder = task.tile.name, scratch / "pictures"
    target = order.out / f"{name}.gpkg"
    if task.cuttings:
        inputs = _of_orthophoto(order, task.tile.extent_deg, task.cuttings)
    else:
        inputs = _of_photos(order, task, folder)
    unusable = inputs.unusable
    done = DoneTile(name=name, unusable=tuple(unusable))
    if target.exists():
        with PlaceMap.open(target) as there:
            if there.inputs_sha256 == inputs.sha256:
                return _describe(done, there)
    if lost := _lost(target, inputs.is_named):
        return replace(done, problem=lost)
    if task.photos and not task.inside.intersection(inputs.paths.values()):
        return done

    def report_unusable(error: ImageError) -> None:
        name = next((name for name in inputs.paths if f"{folder / name}" in str(error)), None)
        if name is None or inputs.paths[name] in task.inside:  # the task of its own tile reports any other
            unusable.append(str(error).replace(f"{folder / name}", inputs.paths[name]) if name else str(error))

    path, whole = scratch / "inside.gpkg", scratch / "map.gpkg"
    ordered = MapOrder(
        path=str(whole),
        pictures=inputs.pictures,
        technique=TECHNIQUE,
        parameters={name: str(value) for name, value in camera_setting(TECHNIQUE, order.camera).items()},
        refine=order.refine,
        calibrate=order.calibrate,
    )
    make_map(ordered, order.config, report_unusable, lambda items, *_: items)
    done = replace(done, unusable=tuple(unusable))
    if not select(whole, path, inputs.inside):
        return done
    with PlaceMap.open_for_adding(path) as place_map:
        place_map.record_inputs(inputs.sha256)
        done = _describe(replace(done, is_new=True), place_map)
    unfinished = target.with_name(f".{target.name}.{scratch.name}")
    try:
        shutil.copyfile(path, unfinished)
        unfinished.replace(target)
    finally:
        unfinished.unlink(missing_ok=True)
    return done


def _describe(done: DoneTile, place_map: PlaceMap) -> DoneTile:
    """Return the result of a task with what its map holds."""
    return replace(done, places=len(place_map), is_calibrated=read_calibration_for(place_map) is not None)


def _lost(target: Path, is_named: Callable[[str], bool]) -> str | None:
    """Return why a tile's map is not to be replaced: it has pictures that the task does not name (None: none)."""
    if not target.exists():
        return None
    with PlaceMap.open(target) as place_map:
        names = [place.source_image for place in place_map.places()]
    lost = sorted(name for name in names if not is_named(name))
    if not lost:
        return None
    return (
        f"its map has {len(lost)} pictures that this run does not name, such as {lost[0]}: name their folders and "
        f"tables too, map into another folder, or remove {target.name}"
    )


def _hash_of(order: FleetOrder, texts: Iterable[str]) -> str:
    """Return the hash of an order's settings and of texts about pictures."""
    source, salience = order.config.source, order.config.salience
    settings = source, salience, order.config.match, order.refine, order.calibrate
    return hashlib.sha256("\n".join([repr(settings), *texts]).encode()).hexdigest()
