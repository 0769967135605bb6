"""Maps larger than an aircraft: ground divided into tiles, each mapped by a worker of Dask as `map build` maps it.

What a worker does depends on its task alone, and a map appears in the folder as a whole: a task can be done again, by
another worker or by the next run. A tile whose map was made of the same is left as it is."""

import hashlib
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from edgevpr import __version__
from edgevpr.core.config import Config
from edgevpr.core.errors import EdgevprError, MapBusyError, MapError, UsageError
from edgevpr.core.geodesy import moved
from edgevpr.core.quadkeys import extent_of_key, keys_at, keys_over, zoom_of_places, zoom_of_spacing
from edgevpr.fleet import index
from edgevpr.fleet.index import Tile, path_of, tile_of
from edgevpr.fleet.photos import Photo, gathered
from edgevpr.mapmaking.cuttings import NoPlaceError
from edgevpr.mapmaking.making import Cuttings, FlownPictures, MapOrder, make_map
from edgevpr.places import mapfiles
from edgevpr.places.examine import select
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.preflight.pick import camera_setting
from edgevpr.techniques import create

if TYPE_CHECKING:
    from dask.distributed import Client

_log = logging.getLogger(__name__)

TECHNIQUE = "cohog"
_MARGIN_M = 150.0  # around a tile: photographs from which its own are refined, and told from
_CONNECT_S = 10.0


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
    """A tile to be mapped: its quad key, and what of: `cuttings` of an orthophoto, or `photos`, in the tile and around
    it, those `inside` by their names. `known_sha256`: hash of what its map was made of (None: there is no map)."""

    key: str
    cuttings: Cuttings | None = None
    photos: tuple[Photo, ...] = ()
    inside: frozenset[str] = frozenset()
    known_sha256: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DoneTile:
    """The end of the task for the tile with the quad key `key`. `tile`: what the index says of it (None: nothing of it
    can be mapped). `is_new`: its map was made now. `unusable`: sentences about pictures that could not be used.
    `problem`: why it could not be mapped (None: it could)."""

    key: str
    tile: Tile | None = None
    is_new: bool = False
    unusable: tuple[str, ...] = ()
    problem: str | None = None


def tasks_of_photos(photos: Sequence[Photo], places_per_tile: int, zoom: int | None) -> tuple[list[TileTask], int]:
    """Divide photographs into tiles, of `zoom` (None: so that none has more than `places_per_tile`). Returns the tasks,
    and how many photographs have no position, and so no tile."""
    placed = [photo for photo in photos if photo.tag.position]
    if not placed:
        raise UsageError("No photograph has a position, and without it has no tile: give a positions.csv beside them.")
    points = [photo.tag.position for photo in placed if photo.tag.position]
    lat_deg, lon_deg = np.array([(point.lat_deg, point.lon_deg) for point in points]).T
    zoom = zoom_of_places(lat_deg, lon_deg, places_per_tile) if zoom is None else zoom
    keys, tasks = keys_at(lat_deg, lon_deg, zoom), []
    for key in np.unique(keys).tolist():
        (south, west), (north, east) = _around(key)
        inside = keys == key
        near = inside | ((lat_deg > south) & (lat_deg < north) & ((lon_deg - west) % 360 < (east - west) % 360))
        names = frozenset(placed[at].name for at in np.flatnonzero(inside))
        tasks.append(TileTask(key=key, photos=tuple(placed[at] for at in np.flatnonzero(near)), inside=names))
    return tasks, len(photos) - len(placed)


def _around(key: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the corners (lat, lon), south-west and north-east, of a tile and its margin."""
    south, west, north, east = extent_of_key(key)
    return moved(south, west, -_MARGIN_M, -_MARGIN_M), moved(north, east, _MARGIN_M, _MARGIN_M)


def tasks_of_orthophoto(cuttings: Cuttings, places_per_tile: int, zoom: int | None) -> list[TileTask]:
    """Divide the ground of an orthophoto into tiles, of `zoom` (None: so that none has more than `places_per_tile`)."""
    extent_deg = cuttings.extent_deg()
    if zoom is None:
        if not cuttings.spacing_m > 0:  # false for NaN
            raise UsageError(f"--spacing-m is {cuttings.spacing_m:g}: give more than 0.")
        zoom = zoom_of_spacing(
            (extent_deg[0] + extent_deg[2]) / 2, cuttings.spacing_m, places_per_tile / np.size(cuttings.footprint_m)
        )
    return [TileTask(key=key, cuttings=replace(cuttings, tile=key)) for key in keys_over(extent_deg, zoom)]


def build(
    order: FleetOrder,
    tasks: Sequence[TileTask],
    scheduler: str | None,
    workers: int | None,
    shown: Callable[[Iterable[Any], int, str], Iterable[Any]],
) -> Iterator[DoneTile]:
    """Map the tiles of `tasks` by the workers of the Dask `scheduler` (None: by `workers` of this computer; None: one a
    core), and write the index. Yields what became of each. `shown` shows progress. Raises EdgevprError."""
    from dask.distributed import as_completed

    order.out.mkdir(parents=True, exist_ok=True)
    with _alone(order.out), _client(scheduler, workers) as client:
        tiles = index.tiles_in(order.out)
        _require_alike(tiles.values(), order)
        hashes = {key: tile.inputs_sha256 for key, tile in tiles.items()}
        futures = {
            client.submit(build_tile, replace(task, known_sha256=hashes.get(task.key)), order, pure=False): task.key
            for task in tasks
        }
        try:
            for future in shown(as_completed(futures), len(futures), "tiles"):
                try:
                    done = future.result()
                except Exception as error:  # a task returns what edgevpr can say: this is a worker's or Dask's
                    done = DoneTile(key=futures[future], problem=_sentence(error))
                if done.tile:
                    tiles[done.tile.key] = done.tile
                yield done
        finally:
            index.write(order.out, (tiles[key] for key in sorted(tiles)))


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep other runs out of a folder, and remove what a run that was killed has left."""
    try:
        lock = mapfiles.lock(folder / ".building", make=True)
    except MapBusyError:
        raise MapBusyError(
            f"{folder}: another run is mapping into it: wait until it has finished, or stop it."
        ) from None
    try:
        for unfinished in folder.glob(".*.gpkg.*"):
            unfinished.unlink()
        yield
    finally:
        os.close(lock)


@contextmanager
def _client(scheduler: str | None, workers: int | None) -> Iterator["Client"]:
    """Connect to a scheduler, or start workers here. Raises UsageError if there is none, or none that can be used."""
    from dask.distributed import Client, LocalCluster

    for name in ("distributed", "pyogrio"):  # they tell of each connection, and of lost ones with a traceback
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if scheduler is None:
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, silence_logs=logging.CRITICAL, dashboard_address=":0"
            )
            stack.enter_context(cluster)
        try:
            client = stack.enter_context(Client(scheduler or cluster, timeout=_CONNECT_S))
        except (OSError, ValueError):
            raise UsageError(
                f"There is no Dask scheduler at {scheduler}: start one (`dask scheduler`), and give tcp://HOST:8786."
            ) from None
        try:
            versions = set(client.run(_version).values())
        except ImportError:
            versions = {"none"}
        if not versions:
            raise UsageError(f"{scheduler} has no workers: start some, `dask worker {scheduler}`.")
        if versions != {__version__}:
            other = ", ".join(sorted(versions - {__version__}))
            raise UsageError(f"A worker has edgevpr {other}, and {__version__} asks: install the same on all machines.")
        _log.info("%d workers, to be watched at %s", len(client.ncores()), client.dashboard_link)
        yield client


def _version() -> str:
    return __version__


def _require_alike(tiles: Iterable[Tile], order: FleetOrder) -> None:
    """Raise MapError if a tile that is there was mapped by another technique than the new ones will be."""
    spec = create(TECHNIQUE, camera_setting(TECHNIQUE, order.camera)).spec
    for tile in tiles:
        if tile.technique != index.technique_text(spec):
            raise MapError(
                f"{path_of(order.out, tile.key)} is of {tile.technique}, and new tiles would be of "
                f"{index.technique_text(spec)}: map into another folder."
            )


def _sentence(error: BaseException) -> str:
    """Return why a worker could not say what became of a tile."""
    kind = type(error).__name__
    if isinstance(error, CancelledError):
        return "the connection to the scheduler is lost: run this again, and it goes on"
    if kind == "KilledWorker":
        return "the workers that mapped it have died: see if their memory is enough"
    return f"{kind}: {error}"


def build_tile(task: TileTask, order: FleetOrder) -> DoneTile:
    """Map one tile; a worker runs this."""
    if order.version != __version__:  # a worker that has come later
        problem = f"a worker has edgevpr {__version__}, and {order.version} asks: install the same on all machines"
        return DoneTile(key=task.key, problem=problem)
    logging.getLogger("edgevpr").setLevel(logging.ERROR)  # the index says what a tile lacks
    cv2.setNumThreads(1)  # there is a worker for every core
    try:
        with tempfile.TemporaryDirectory(prefix="edgevpr-tile-") as scratch:
            return _built(task, order, Path(scratch))
    except NoPlaceError:
        return DoneTile(key=task.key)
    except EdgevprError as error:  # as text: not every error can travel
        return DoneTile(key=task.key, problem=str(error))


@dataclass(frozen=True, slots=True)
class _Inputs:
    """All that a tile is mapped from: the `pictures`, the hash of their content and of the settings, the function that
    says if a picture's name is one of theirs, and sentences about those that cannot be used."""

    pictures: Cuttings | FlownPictures
    sha256: str
    is_named: Callable[[str], bool]
    unusable: list[str]


def _inputs(task: TileTask, order: FleetOrder, scratch: Path) -> _Inputs:
    """Open the ground of a task, or bring its photographs here. Raises NoPlaceError if it has no ground."""
    if cuttings := task.cuttings:
        said = repr(replace(cuttings, orthophoto="", area=None))
        with closing(cuttings.open()) as source:
            ground = [hashlib.sha256(each).hexdigest() for each in source.ground(cuttings.spacing_m)]
        of_this = f"{source.short_name}_"
        return _Inputs(cuttings, _hash_of(order, [said, *ground]), lambda name: name.startswith(of_this), [])
    folder = scratch / "pictures"
    folder.mkdir()
    hashes = list(gathered(task.photos, folder))
    unusable = [f"{photo.uri} cannot be read" for photo, found in hashes if found is None]
    sha256 = _hash_of(order, sorted(f"{photo.name} {found}" for photo, found in hashes if found))
    names = {photo.name for photo in task.photos}
    return _Inputs(FlownPictures(source=str(folder)), sha256, lambda name: name in names, unusable)


def _built(task: TileTask, order: FleetOrder, scratch: Path) -> DoneTile:
    inputs, target = _inputs(task, order, scratch), path_of(order.out, task.key)
    unusable = inputs.unusable
    if inputs.sha256 == task.known_sha256:
        return DoneTile(key=task.key, tile=tile_of(target), unusable=tuple(unusable))
    if lost := _lost(target, inputs.is_named):
        return DoneTile(key=task.key, problem=lost)
    path = scratch / "map.gpkg"
    ordered = MapOrder(
        path=str(path),
        pictures=inputs.pictures,
        technique=TECHNIQUE,
        parameters={name: str(value) for name, value in camera_setting(TECHNIQUE, order.camera).items()},
        refine=order.refine,
        calibrate=order.calibrate,
    )
    made = make_map(ordered, order.config, lambda error: unusable.append(str(error)), lambda items, *_: items)
    if task.photos:
        path, whole = scratch / "inside.gpkg", path
        made_here = select(whole, path, lambda place: place.source_image in task.inside)
    else:
        made_here = made.places
    if not made_here:
        return DoneTile(key=task.key, unusable=tuple(unusable))
    with PlaceMap.open_for_adding(path) as place_map:
        place_map.record_inputs(inputs.sha256)
    unfinished = target.with_name(f".{target.name}.{scratch.name}")
    try:
        shutil.copyfile(path, unfinished)
        unfinished.replace(target)
    finally:
        unfinished.unlink(missing_ok=True)
    return DoneTile(key=task.key, tile=tile_of(target), is_new=True, unusable=tuple(unusable))


def _lost(target: Path, is_named: Callable[[str], bool]) -> str | None:
    """Return why a tile's map is not to be replaced: it has pictures that the task does not name (None: none)."""
    if not target.exists():
        return None
    with PlaceMap.open(target) as place_map:
        lost = sorted(place.source_image for place in place_map.places() if not is_named(place.source_image))
    if not lost:
        return None
    return (
        f"its map has {len(lost)} pictures that this run does not name, such as {lost[0]}: name their folders and "
        "tables too, or map into another folder"
    )


def _hash_of(order: FleetOrder, texts: Iterable[str]) -> str:
    """Return the hash of an order's settings and of texts about pictures."""
    source, salience = order.config.source, order.config.salience
    settings = source, salience, order.config.match, order.refine, order.calibrate
    return hashlib.sha256("\n".join([repr(settings), *texts]).encode()).hexdigest()
