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

from edgevpr.core.errors import MapBusyError, MapError, UsageError
from edgevpr.core.quadkeys import (
    extent_around,
    in_extent,
    keys_over,
    maps_in,
    tile_keys,
    zoom_of_places,
    zoom_of_spacing,
)
from edgevpr.fleet import index
from edgevpr.fleet.index import Tile, find_tile
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
    points = {uri: tag.position for uri, tag in photos.items() if tag.position}
    if not points:
        raise UsageError("No photograph has a position, and without it has no tile: give a positions.csv beside them.")
    lat_deg, lon_deg = np.array([(point.lat_deg, point.lon_deg) for point in points.values()]).T
    zoom = zoom_of_places(lat_deg, lon_deg, places_per_tile) if zoom is None else zoom
    uris, northwards, tasks = list(points), np.argsort(lat_deg), []
    keys = tile_keys(lat_deg, lon_deg, zoom)
    for key in np.unique(keys).tolist():
        extent_deg = extent_around(key, MARGIN_M)
        near = northwards[slice(*np.searchsorted(lat_deg, extent_deg[::2], sorter=northwards))]
        near = np.sort(near[in_extent(extent_deg, lat_deg[near], lon_deg[near])])
        inside = frozenset(uris[at] for at in near[keys[near] == key])
        tasks.append(TileTask(key=key, photos={uris[at]: photos[uris[at]] for at in near}, inside=inside))
    return tasks, len(photos) - len(points)


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
        _require_alike(order)
        tiles: dict[str, Tile] = {}
        futures = {client.submit(build_tile, task, order, pure=False): task.key for task in tasks}
        try:
            for future in shown(as_completed(futures), len(futures), "tiles"):
                key = futures.pop(future)  # what nobody holds is not done again where the worker that has it dies
                try:
                    done = future.result()
                except Exception as error:  # a task returns what edgevpr can say: this is a worker's or Dask's
                    done = DoneTile(key=key, problem=_sentence(error))
                del future
                if done.tile:
                    tiles[done.tile.key] = done.tile
                yield done
        finally:
            paths = maps_in(order.out)
            index.write(order.out, (tiles[key] if key in tiles else find_tile(path) for key, path in paths.items()))


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

    for name in ("distributed", "pyogrio"):  # they log each connection, and lost ones with a traceback
        logging.getLogger(name).setLevel(logging.CRITICAL)
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
    wanted = index.technique_text(create(TECHNIQUE, camera_setting(TECHNIQUE, order.camera)).spec)
    for path in maps_in(order.out).values():
        with PlaceMap.open(path) as place_map:
            found = index.technique_text(place_map.spec)
        if found != wanted:
            raise MapError(f"{path} is of {found}, and new tiles would be of {wanted}: map into another folder.")


def _sentence(error: BaseException) -> str:
    """Return why a worker could not say what became of a tile."""
    kind = type(error).__name__
    if isinstance(error, CancelledError):
        return "the connection to the scheduler is lost: run this again, and it goes on"
    if kind == "KilledWorker":
        return "the workers that mapped it have died: see if their memory is enough"
    return f"{kind}: {error}"
