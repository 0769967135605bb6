"""Maps larger than an aircraft: ground divided into tiles, each mapped by a worker of Dask (see `worker`)."""

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from edgevpr.core.errors import MapBusyError, UsageError
from edgevpr.core.geodesy import is_in_extent, widen_extent
from edgevpr.fleet.grid import Tile, list_tiles, locate, parse_zoom, zoom_of_places, zoom_of_spacing
from edgevpr.fleet.photos import Photos
from edgevpr.fleet.worker import MARGIN_M, TECHNIQUE, DoneTile, FleetOrder, TileTask, build_tile
from edgevpr.mapmaking.making import Cuttings
from edgevpr.places import mapfiles
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.preflight.pick import camera_setting
from edgevpr.techniques import create

if TYPE_CHECKING:
    from dask.distributed import Client

_log = logging.getLogger(__name__)

_CONNECT_S = 10.0


def tasks_of_photos(photos: Photos, places_per_tile: int, zoom: int | None) -> tuple[list[TileTask], int]:
    """Divide photographs into tiles, of `zoom` (None: so that none has more than `places_per_tile`). Returns the tasks,
    and how many photographs have no position, and so no tile."""
    points = {path: tag.position for path, tag in photos.items() if tag.position}
    if not points:
        raise UsageError("No photograph has a position, and without it has no tile: give a positions.csv beside them.")
    lat_deg, lon_deg = np.array([(point.lat_deg, point.lon_deg) for point in points.values()]).T
    zoom = zoom_of_places(lat_deg, lon_deg, places_per_tile) if zoom is None else zoom
    paths, northwards, tasks = list(points), np.argsort(lat_deg), []
    squares = locate(lat_deg, lon_deg, zoom)
    for square in np.unique(squares, axis=0):
        tile = Tile(zoom, *square.tolist())
        extent_deg = widen_extent(tile.extent_deg, MARGIN_M)
        near = northwards[slice(*np.searchsorted(lat_deg, extent_deg[::2], sorter=northwards))]
        near = np.sort(near[is_in_extent(extent_deg, lat_deg[near], lon_deg[near])])
        inside = frozenset(paths[at] for at in near[(squares[near] == square).all(axis=1)])
        tasks.append(TileTask(tile=tile, photos={paths[at]: photos[paths[at]] for at in near}, inside=inside))
    return tasks, len(photos) - len(points)


def tasks_of_orthophoto(cuttings: Cuttings, places_per_tile: int, zoom: int | None) -> list[TileTask]:
    """Divide the ground of an orthophoto into tiles, of `zoom` (None: so that none has more than `places_per_tile`)."""
    extent_deg = cuttings.extent_deg()
    if zoom is None:
        if not cuttings.spacing_m > 0:  # false for NaN
            raise UsageError(f"--spacing-m is {cuttings.spacing_m:g}: give more than 0.")
        zoom = zoom_of_spacing(cuttings.spacing_m, places_per_tile / np.size(cuttings.footprint_m))
    return [
        TileTask(tile=tile, cuttings=replace(cuttings, tile_deg=tile.extent_deg))
        for tile in list_tiles(extent_deg, zoom)
    ]


def list_maps(folder: Path) -> list[Path]:
    """Return the maps of tiles in a folder."""
    return sorted(path for path in folder.glob("*.gpkg") if parse_zoom(path.stem) is not None)


def build(
    order: FleetOrder,
    tasks: Sequence[TileTask],
    scheduler: str | None,
    workers: int | None,
    shown: Callable[[Iterable[Any], int, str], Iterable[Any]],
) -> Iterator[DoneTile]:
    """Map the tiles of `tasks` by the workers of the Dask `scheduler` (None: by `workers` of this computer; None: one a
    core). Yields what became of each. `shown` shows progress. Raises EdgevprError."""
    from dask.distributed import as_completed

    order.out.mkdir(parents=True, exist_ok=True)
    with _alone(order.out), _client(scheduler, workers) as client:
        _require_alike(order)
        futures = {client.submit(build_tile, task, order, pure=False): task.tile.name for task in tasks}
        for future in shown(as_completed(futures), len(futures), "tiles"):
            name = futures.pop(future)  # what nobody holds is not done again where the worker that has it dies
            try:
                done = future.result()
            except Exception as error:  # a task returns what edgevpr can say: this is a worker's or Dask's
                done = DoneTile(name=name, problem=_sentence(error))
            del future
            yield done


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
    from dask.distributed import Client

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # it logs lost connections with a traceback
    own = {"n_workers": workers, "threads_per_worker": 1, "silence_logs": logging.CRITICAL, "dashboard_address": ":0"}
    try:
        connected = Client(scheduler, timeout=_CONNECT_S, **({} if scheduler else own))
    except (OSError, ValueError):
        raise UsageError(
            f"There is no Dask scheduler at {scheduler}: start one (`dask scheduler`), and give tcp://HOST:8786."
        ) from None
    with connected as client:
        if not client.ncores():
            raise UsageError(f"{scheduler} has no workers: start some, `dask worker {scheduler}`.")
        _log.info("%d workers, to be watched at %s", len(client.ncores()), client.dashboard_link)
        yield client


def _require_alike(order: FleetOrder) -> None:
    """Raise MapError if a tile in the folder was mapped by another technique than the new ones will be."""
    wanted = create(TECHNIQUE, camera_setting(TECHNIQUE, order.camera)).spec
    for path in list_maps(order.out):
        with PlaceMap.open(path) as place_map:
            place_map.require(wanted)


def _sentence(error: BaseException) -> str:
    """Return why a worker could not say what became of a tile."""
    kind = type(error).__name__
    if isinstance(error, CancelledError):
        return "the connection to the scheduler is lost: run this again, and it goes on"
    if kind == "KilledWorker":
        return "the workers that mapped it have died: see if their memory is enough"
    return f"{kind}: {error}"
