"""Flights for flights.py: where the aircraft is at each query, what the autopilot says of it, and what the camera sees.

Metres are east and north of the middle of the site whose map is flown with.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from flight_sites import Site

from edgevpr.core.geodesy import offset_position
from edgevpr.core.types import Vehicle
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light
from edgevpr.lab.simulate.generated import make_oscillation
from edgevpr.lab.simulate.overflight import photograph_ground
from edgevpr.mapmaking.orthophoto import Orthophoto

QUERIES = 40
ON_THE_WAY = (
    "along",
    "half speed",
    "double speed",
    "backwards",
    "turning back",
    "hover",
    "stop and go",
    "jump",
    "leave",
)
KINDS = (*ON_THE_WAY, "across", "foreign")
# What is wrong with the odometry from a third of the flight on, or, where it is missing, from its beginning.
ODOMETRY = ("good", "good", "stops", "good", "doubles", "good", "halves", "missing", "good", "not a number")
_CRUISE_M_S, _FASTEST_M_S, _INTERVAL_S = 10.0, 25.0, (1.0, 6.0)
_BIAS_M_S, _NOISE_M_S, _SCALE_SD, _HEADING_SD_DEG = 0.5, 0.3, 0.05, 5.0
_ASIDE = 0.12  # footprints beside the mapped way
_SWAY_DEG = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """One flight, a row a query: `t_s`; where the aircraft is, `at` (N, 2), with `heading_deg` and `footprints_m`
    (ground along the longest side of a picture); what is under it, `over` (N,), the name of a site; and where in the
    metres of that site, `seen` (N, 2). `jumped`: it was carried there since the query before, and no odometry tells."""

    t_s: np.ndarray
    at: np.ndarray
    heading_deg: np.ndarray
    footprints_m: np.ndarray
    over: np.ndarray
    seen: np.ndarray
    jumped: np.ndarray


def fly(kind: str, site: Site, other: Site, rng: np.random.Generator) -> Track:
    """Make the track of a flight over a site; where it leaves the map, it goes on over the `other`."""
    jumped, over = np.zeros(QUERIES, bool), np.full(QUERIES, site.name, dtype=object)
    if kind == "foreign":
        over[:] = other.name
        seen = _across(other, QUERIES, rng)
        at = (seen - seen[0]) * site.footprint_m / other.footprint_m + site.way[0]
    elif kind == "across":
        at = seen = _across(site, QUERIES, rng)
    else:
        along, jumped = _along(kind, site, rng)
        at = seen = _beside(site, along, rng)
        if kind == "leave":
            at, seen = at.copy(), seen.copy()
            away = slice(QUERIES // 3, 2 * QUERIES // 3)
            over[away], seen[away] = other.name, _loop(other, away.stop - away.start, rng)
            at[away] = at[away.start - 1] + (seen[away] - seen[away.start]) * site.footprint_m / other.footprint_m
    step_m = float(np.median(np.hypot(*np.diff(site.way, axis=0).T)))
    interval_s = float(np.clip(step_m / _CRUISE_M_S, *_INTERVAL_S))
    flown_m = np.where(jumped, 0, np.hypot(*np.diff(at, axis=0, prepend=at[:1]).T))
    t_s = 100.0 + np.cumsum(np.maximum(interval_s, flown_m / _FASTEST_M_S))  # the mapped way has holes
    return Track(
        t_s=t_s,
        at=at,
        heading_deg=_headings(at, jumped, rng),
        footprints_m=_footprints(site, other, over, seen, rng),
        over=over,
        seen=seen,
        jumped=jumped,
    )


def _along(kind: str, site: Site, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return which place of the way each query is at (N,), between two places too, and where it was carried."""
    last, jumped = len(site.way) - 1, np.zeros(QUERIES, bool)
    pace = np.ones(QUERIES)
    if kind == "half speed":
        pace[:] = 0.5
    elif kind == "double speed":
        pace[:] = 2.0
    elif kind == "hover":
        pace[QUERIES // 4 : 3 * QUERIES // 4] = 0.0
    elif kind == "stop and go":
        pace = np.repeat(rng.permutation(np.tile([0.0, 1.0], QUERIES // 8)), 4)[:QUERIES].astype(float)
    elif kind == "leave":  # it comes back to where it has left the map
        pace[QUERIES // 3 : 2 * QUERIES // 3 + 1] = 0.0
    places = rng.uniform(0, max(0.0, last - pace.sum())) + np.cumsum(pace)
    if kind == "turning back":
        places = places[0] + _folded(np.arange(QUERIES), min(QUERIES // 3, last))
    places = _folded(places, last)
    if kind == "backwards":
        places = last - places
    elif kind == "jump":
        for at in (QUERIES // 3, 2 * QUERIES // 3):
            places[at:] = _folded(places[at:] + last / 2, last)
            jumped[at] = True
    return places, jumped


def _folded(places: np.ndarray, last: int) -> np.ndarray:
    """Turn back at both ends of the way."""
    return last - abs(places % (2 * last) - last)


def _beside(site: Site, places: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return points beside the mapped way, as far aside as another flight would be."""
    numbers = np.arange(len(site.way))
    points = np.column_stack([np.interp(places, numbers, site.way[:, axis]) for axis in (0, 1)])
    aside = np.column_stack([make_oscillation(rng, len(places)) for _ in range(2)]) * _ASIDE * site.footprint_m
    still = np.append(False, np.diff(places) == 0)
    for at in np.flatnonzero(still):  # hovering, it stays within a fiftieth of a picture
        aside[at] = aside[at - 1] + rng.normal(0, 0.005, 2) * site.footprint_m
    return site.snapped(points + aside)


def _across(site: Site, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return points on straight lines between random points that can be flown over, far from each other, at the pace of
    the mapped flight."""
    free = site.room.points()
    step_m = float(np.median(np.hypot(*np.diff(site.way, axis=0).T)))
    line = [free[rng.integers(len(free))]]
    while len(line) < count:
        ends = free[rng.integers(len(free), size=20)]
        end = ends[np.argmax(np.hypot(*(ends - line[-1]).T))]
        steps = max(1, round(float(np.hypot(*(end - line[-1]))) / step_m))
        line += [line[-1] + (end - line[-1]) * part for part in np.arange(1, steps + 1) / steps]
    return site.snapped(np.array(line[:count]))


def _loop(site: Site, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return points that lead away and back again."""
    out = _across(site, (count + 1) // 2, rng)
    return np.vstack([out, out[::-1]])[:count]


def _headings(at: np.ndarray, jumped: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return headings (N,): the nose is turned from the course by an angle of the flight, and swings."""
    step = np.vstack([at[1] - at[0], np.diff(at, axis=0)])
    course, known = np.zeros(len(at)), 0.0
    for number, (east, north) in enumerate(step):
        if not jumped[number] and np.hypot(east, north) > 1.0:
            known = np.degrees(np.arctan2(east, north))
        course[number] = known
    return (course + rng.uniform(0, 360) + 5.0 * make_oscillation(rng, len(at))) % 360


def _footprints(site: Site, other: Site, over: np.ndarray, seen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the ground under the pictures: that of the nearest place, since the scale of a mosaic is not the same all
    over, as seen from up to a fifth lower or higher, and lower where there is not so much ground."""
    nearest = np.argmin(((seen[:, None] - site.way[None]) ** 2).sum(axis=2), axis=1)
    own = np.convolve(np.pad(site.footprints_m[nearest], 2, mode="edge"), np.ones(5) / 5, mode="valid")
    higher = rng.uniform(0.8, 1.2) * (1 + 0.03 * make_oscillation(rng, len(seen)))
    at_home = over == site.name
    widest_m = np.where(at_home, site.widest_m.at(seen), other.widest_m.at(seen))
    return np.minimum(np.where(at_home, own, other.footprint_m) * higher, widest_m)


def reports(track: Track, site: Site, how: str, rng: np.random.Generator) -> list[Vehicle | None]:
    """Return what the autopilot says at each query, of its odometry only: a velocity whose scale, bias and noise are
    wrong, and the position that it leads to. `how` is one of `ODOMETRY`."""
    step_s = np.diff(track.t_s, prepend=track.t_s[0] - 1)[:, None]
    true = np.diff(track.at, axis=0, prepend=track.at[:1]) / step_s
    true[track.jumped] = 0
    bias = _BIAS_M_S * np.column_stack([make_oscillation(rng, len(true)) for _ in range(2)])
    told = true * rng.normal(1, _SCALE_SD) + bias + rng.normal(0, _NOISE_M_S, true.shape)
    from_here = len(true) // 3
    told[from_here:] *= {"doubles": 2.0, "halves": 0.5}.get(how, 1.0)
    heading = track.heading_deg + rng.normal(0, _HEADING_SD_DEG) + rng.normal(0, 1, len(true))
    at = track.at[0] + np.cumsum(told * step_s, axis=0)
    said: list[Vehicle | None] = []
    for number, t_s in enumerate(track.t_s.tolist()):
        if how == "stops" and number > from_here:
            said.append(said[-1])
            continue
        lat_deg, lon_deg = offset_position(*site.origin, *at[number].tolist())
        velocity = tuple(told[number].tolist())
        if how == "not a number" and number >= from_here:
            velocity = (np.nan, np.nan)
        vehicle = Vehicle(
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_m=100.0,
            heading_deg=float(heading[number] % 360),
            t_received_s=t_s - 0.05,
            has_gps=False,
            velocity_m_s=velocity,
        )
        said.append(None if how == "missing" else vehicle)
    return said


def photographs(
    track: Track, photos: Mapping[str, Orthophoto], sites: Mapping[str, Site], rng: np.random.Generator
) -> Iterator[np.ndarray | None]:
    """Take the pictures of a flight, in light and by a camera of its own, uint8 (480, 640, 3) BGR; None where too
    little of one has ground."""
    light = Light(
        sun_azimuth_deg=0,
        sun_elevation_deg=90,
        haze_frac=rng.uniform(0, 0.2),
        exposure=rng.uniform(0.7, 1.3),
        gamma=rng.uniform(0.8, 1.25),
    )
    camera = replace(Camera(), noise_sigma=rng.uniform(1, 5), blur_px=rng.uniform(0, 2.5))
    quality = (cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(70, 95)))
    roll, pitch = (_SWAY_DEG * make_oscillation(rng, len(track.at)) for _ in range(2))
    for number, name in enumerate(track.over):
        pose = CameraPose(
            east_m=0.0,
            north_m=0.0,
            height_m=float(track.footprints_m[number]) * camera.focal_px / camera.width,
            heading_deg=float(track.heading_deg[number]),
            roll_deg=float(roll[number]),
            pitch_deg=float(pitch[number]),
        )
        image = photograph_ground(photos[name], sites[name].position(track.seen[number]), pose, camera, light, rng)
        yield image if image is None else cv2.imdecode(cv2.imencode(".jpg", image, quality)[1], cv2.IMREAD_COLOR)
