"""What is left of a map that several flights made of the same ground: `make bench-fleet`.

A map is made of the pictures of some flights, as `edgevpr fleet build` makes a tile: as they are, and with the passes
compared. A flight that is in neither is matched with both, each picture alone and nothing told. Flights over sat_marash
are simulated over its rasters from 120 m, with another light, sway and nose every time: those of summer over `before`,
of winter over `after`, months later and after an earthquake. Their 40 pictures hardly overlap; close are 96 pictures,
three tenths of the footprint apart. What fades is a winter mapped once, before three flights of the summer. Pictures of
aerial_caliterra are one flight, of which every third one is taken as a flight; aerial_swindale has three real ones.
Their positions are refined; maps have the shipped confidence. The number of landmarks that tells one condition from
another was chosen on sat_marash and aerial_caliterra.

Right: the best place is within half a footprint of where the picture was taken. Wrong: accepted, and the fix is more
than a quarter of the footprint off; of the photographs, accepted, and the place shares no ground with the picture by
the mosaic of the set. Their errors hold the mosaic against the map: both lie where GPS says, to tens of metres.
"""

import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import base
import cv2
import numpy as np
import walks
from base import Row
from from_orthophoto import ground_of, laid
from from_space import FOOTPRINT_M, FOV_DEG, HEIGHT_M

from edgevpr.core.geodesy import distance_m, moved
from edgevpr.core.types import Place, Position
from edgevpr.fleet.photos import gather, photos_of
from edgevpr.frames.positions import GeoTag, read_positions, write_positions
from edgevpr.lab.simulate.camera import Camera, Light
from edgevpr.lab.simulate.rehearsal import poses_of, seen_from
from edgevpr.mapmaking.making import FlownPictures, MapOrder, make_map
from edgevpr.mapmaking.orthophoto import Orthophoto
from edgevpr.mapmaking.passes import history_of
from edgevpr.places.examine import select
from edgevpr.places.layers import layers_of
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import open_recogniser

RASTERS, CUT, REAL = "sat_marash", "aerial_caliterra", "aerial_swindale"
_BESIDE_M, _GPS_SD_M, _EXPOSURES = 12.0, 3.0, (1.0, 0.8, 1.15, 0.9)
_WIDE, _CLOSE, _ACROSS = (8, 5, 140.0), (12, 8, 47.0), (9, 6, 62.0)  # columns and rows of pictures, and metres between
_LONGEST_PX = 640
_ENDS = 58, 79, 123  # of the three flights of aerial_swindale, by its README and the times
_COLUMNS = {
    "flights": "{flights}",
    "flown with it": "{held}",
    "compared": "{compared}",
    **{name: f"{{{name}}}" for name in ("places", "MB", "queries", "right", "accepted", "wrong")},
    "fix error m": "{error_m:.1f}",
    "became part / faded / changed": "{merged} / {faded} / {changed}",
    "comparing s": "{t_compare_s:.0f}",
}


LatLon = tuple[float, float]
# Where a picture was taken, in degrees by the tags of all, and in pixels of the set's mosaic.
Truth = Mapping[str, tuple[LatLon, np.ndarray]]


@dataclass(frozen=True, slots=True)
class Case:
    """Flights in the folders `mapped`, in the order of their days, and those `held` out, with a name. `truth`: where
    pictures were taken, by their names (None: their tags say that)."""

    name: str
    mapped: Sequence[Path]
    held: Sequence[Path]
    truth: Truth | None = None


def simulated(folder: Path, raster: Path, day: int, grid: tuple[int, int, float] = _WIDE) -> Path:
    """Write the pictures of a flight over a raster, and their positions as GPS has them."""
    folder.mkdir()
    rng, light = np.random.default_rng(day), Light(sun_azimuth_deg=0, sun_elevation_deg=90)
    light = replace(light, exposure=_EXPOSURES[day // 10 % len(_EXPOSURES)])
    photo, shots, tags = Orthophoto(raster), [], {}
    south, west, _, _ = photo.extent_deg
    columns, rows, between_m = grid
    for row_m in 0.8 * FOOTPRINT_M + between_m * np.arange(rows):
        for column_m in 0.8 * FOOTPRINT_M + between_m * np.arange(columns):
            off_m = rng.uniform(-_BESIDE_M, _BESIDE_M, 2)
            at = Position(*moved(south, west, column_m + off_m[0], row_m + off_m[1]))
            t_utc_s = 1.7e9 + 86_400.0 * day + 5 * len(shots)
            shots.append(GeoTag(position=at, height_m=HEIGHT_M, heading_deg=rng.uniform(0, 360), t_utc_s=t_utc_s))
    for at, (shot, pose) in enumerate(zip(shots, poses_of(shots, day), strict=True)):
        image, here = seen_from(photo, shot.position, pose, Camera(noise_sigma=3.0), light, rng), shot.position
        cv2.imwrite(str(folder / f"{at:03d}.jpg"), image)
        recorded = Position(*moved(here.lat_deg, here.lon_deg, *rng.normal(0, _GPS_SD_M, 2)))
        attitude = {name: getattr(pose, name) for name in ("heading_deg", "roll_deg", "pitch_deg")}
        tags[f"{at:03d}.jpg"] = replace(shot, position=recorded, **attitude)
    write_positions(folder / "positions.csv", tags)
    photo.close()
    return folder


def part_of(work: Path, folder: Path, name: str, files: Sequence[str]) -> Path:
    """Make a folder of some of the pictures of a set."""
    part, tags = work / f"{folder.name} {name}", read_positions(folder / "positions.csv")
    part.mkdir()
    for file in files:
        os.symlink(
            next(path for path in (folder / "ref" / file, folder / "query" / file) if path.exists()), part / file
        )
    write_positions(part / "positions.csv", {file: tags[file] for file in files})
    return part


def truth_of(folder: Path) -> Truth:
    on = laid(folder)
    ground = ground_of(folder, on)
    return {name: (ground.position(at), at) for name, at in on.middle.items()}


def files_of(folder: Path) -> list[str]:
    return sorted(path.name for part in ("ref", "query") for path in (folder / part).iterdir())


def cases(work: Path) -> list[Case]:
    cut, real, rasters = base.find_sets(names=[CUT, REAL, RASTERS])
    summer, winter = (rasters / "raster" / f"{day}.vrt" for day in ("before", "after"))
    summers = [simulated(work / f"summer {day}", summer, day) for day in (10, 20, 30, 40)]
    winters = [simulated(work / f"winter {day}", winter, day) for day in (0, 200, 210, 220)]
    close = [simulated(work / f"summer {day} close", summer, day, _CLOSE) for day in (50, 60)]
    across = simulated(work / "winter 230", winter, 230, _ACROSS)
    thirds = [part_of(work, cut, str(at), files_of(cut)[at::3]) for at in range(3)]
    files, ends = files_of(real), (0, *_ENDS)
    real_flights = [part_of(work, real, str(at), files[ends[at] : ends[at + 1]]) for at in range(3)]
    return [
        Case(f"{RASTERS}: 3 of summer", summers[:3], [summers[3], winters[3]]),
        Case(f"{RASTERS}: 2 of summer, close", close, [across]),
        Case(f"{RASTERS}: 2 of summer, 2 of winter", summers[:2] + winters[1:3], [summers[3], winters[3]]),
        Case(f"{RASTERS}: 1 of winter, then 3 of summer", winters[:1] + summers[:3], summers[3:]),
        Case(f"{CUT}: 2 thirds", thirds[:2], thirds[2:], truth_of(cut)),
        Case(f"{REAL}: flights 1, 2", real_flights[:2], real_flights[2:], truth_of(real)),
    ]


def share_off(place: Place, name: str, here: LatLon, footprint_m: float, truth: Truth | None) -> float:
    """Return how far a place is from where the picture of this name was taken, as a share of the footprint."""
    if truth is None:
        return float(distance_m(*here, place.position.lat_deg, place.position.lon_deg)) / footprint_m
    there = next((at for file, (_, at) in truth.items() if f"_{Path(file).stem}_" in place.source_image), None)
    return np.inf if there is None else float(np.hypot(*(there - truth[name][1]))) / _LONGEST_PX


def asked(path: Path, flight: Path, keys: Row, truth: Truth | None) -> Row:
    """Match the pictures of a flight that is not in a map."""
    recogniser = open_recogniser(walks.config(map=str(path), **keys), load_board("this"))
    footprint_m = layers_of(recogniser.place_map).median_m or 0.0
    right, wrong, errors_m = 0, 0, []
    frames = [frame for frame in walks.frames_of(flight) if truth is None or frame.name in truth]
    for frame in frames:
        event, tag = recogniser.step(replace(frame, position=None)), frame.position
        here = truth[frame.name][0] if truth else (tag.lat_deg, tag.lon_deg)
        off = share_off(event.best.place, frame.name, here, footprint_m, truth) if event.best else np.inf
        right += off < 1 / 2
        if event.accepted and (fix := event.position):
            errors_m.append(float(distance_m(*here, fix.lat_deg, fix.lon_deg)))
            wrong += off > 1 if truth else errors_m[-1] > footprint_m / 4
    recogniser.place_map.close()
    found: Row = {"queries": len(frames), "right": int(right), "accepted": len(errors_m)}
    found |= {"wrong": int(wrong), "held": flight.name.rstrip(" 0123456789")}
    return found | {"error_m": float(np.median(errors_m)) if errors_m else None}


def measured(case: Case, work: Path) -> list[Row]:
    """Make the two maps of a case, and match the flights that are in neither."""
    keys = {"source.camera": "nadir", **({"source.fov_deg": FOV_DEG} if case.name.startswith(RASTERS) else {})}
    photos, pictures, config = photos_of(list(map(str, case.mapped))), work / "pictures", walks.config(**keys)
    pictures.mkdir()
    named = gather(photos, pictures).named
    whole, left = work / "whole.gpkg", work / "left.gpkg"
    order = MapOrder(
        path=str(whole),
        pictures=FlownPictures(source=str(pictures)),
        technique="cohog",
        parameters={"camera": "nadir"},
        refine=not case.name.startswith(RASTERS),
        calibrate=False,
    )
    make_map(order, config, print, lambda items, *_: items)
    folders = {name: photo.uri.rpartition("/")[0] for name, photo in named.items()}
    began_s = time.process_time()
    history = history_of(whole, order.pictures, config, folders, lambda place_map: None)
    counted: Row = {"t_compare_s": time.process_time() - began_s, "changed": len(history.changes)}
    counted["faded"] = sum(part_of is None for part_of in history.removed.values())
    counted["merged"] = len(history.removed) - counted["faded"]
    kept = folders.keys() - history.removed.keys()
    select(whole, left, lambda place_map: [each.place_id for each in place_map.places() if each.source_image in kept])
    rows = []
    for flight in case.held:
        for path, said in ((whole, {"compared": "no"}), (left, {"compared": "yes", **counted})):
            with PlaceMap.open(path) as place_map:
                size = {"places": len(place_map), "MB": round(path.stat().st_size / 1e6, 1)}
            rows.append({"flights": case.name, **size, **said, **asked(path, flight, keys, case.truth)})
            print(rows[-1], flush=True)
    return rows


def main() -> None:
    rows = []
    with tempfile.TemporaryDirectory(prefix="edgevpr-passes-") as work:
        for number, case in enumerate(cases(Path(work))):
            of_case = Path(work) / f"case {number}"
            of_case.mkdir()
            rows += measured(case, of_case)
    found = {**base.made_by(), "rows": rows}
    base.write("passes", found, page(found))


def page(found: Row) -> str:
    return f"""# Several flights over the same ground

{base.told(__doc__)}

{base.table(found["rows"], _COLUMNS, left=3)}

{base.made_line(found, "make bench-fleet")}
"""


if __name__ == "__main__":
    base.run(main)
