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

Rng = np.random.Generator

QUERIES = 40
ROUTE_KINDS = (
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
KINDS = (*ROUTE_KINDS, "across", "foreign")
# What is wrong with the odometry from a third of the flight on, or, where it is missing, from its beginning.
ODOMETRY = ("good", "good", "stops", "good", "doubles", "good", "halves", "missing", "good", "not a number")
_CRUISE_SPEED_M_S = 10.0
_MAX_SPEED_M_S = 25.0
_QUERY_INTERVALS_S = (1.0, 6.0)  # the least and the most
_VELOCITY_BIAS_M_S = 0.5
_VELOCITY_NOISE_M_S = 0.3
_VELOCITY_SCALE_SD = 0.05
_HEADING_SD_DEG = 5.0
_ROUTE_OFFSET = 0.12  # footprints beside the mapped way
_SWAY_DEG = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """One flight, a row a query: `t_s`; `position_m` (N, 2) of the aircraft, with `heading_deg` and `footprints_m`
    (ground along the longest side of a picture); `site_names` (N,) of the ground under it, and `ground_m` (N, 2), its
    position in the metres of that site. `is_jump`: it was carried there since the query before, without odometry."""

    t_s: np.ndarray
    position_m: np.ndarray
    heading_deg: np.ndarray
    footprints_m: np.ndarray
    site_names: np.ndarray
    ground_m: np.ndarray
    is_jump: np.ndarray


def make_track(kind: str, site: Site, other: Site, rng: Rng) -> Track:
    """Make the track of a flight over a site; where it leaves the map, it goes on over the `other`."""
    is_jump, site_names = np.zeros(QUERIES, bool), np.full(QUERIES, site.name, dtype=object)
    if kind == "foreign":
        site_names[:] = other.name
        ground_m = _cross_site(other, QUERIES, rng)
        position_m = (ground_m - ground_m[0]) * site.footprint_m / other.footprint_m + site.route_m[0]
    elif kind == "across":
        position_m = ground_m = _cross_site(site, QUERIES, rng)
    else:
        along, is_jump = _follow_route(kind, site, rng)
        position_m = ground_m = _fly_near_route(site, along, rng)
        if kind == "leave":
            position_m, ground_m = position_m.copy(), ground_m.copy()
            away = slice(QUERIES // 3, 2 * QUERIES // 3)
            count = away.stop - away.start
            out_m = _cross_site(other, (count + 1) // 2, rng)
            site_names[away], ground_m[away] = other.name, np.vstack([out_m, out_m[::-1]])[:count]
            shift_m = (ground_m[away] - ground_m[away.start]) * site.footprint_m / other.footprint_m
            position_m[away] = position_m[away.start - 1] + shift_m
    step_m = float(np.median(np.hypot(*np.diff(site.route_m, axis=0).T)))
    interval_s = float(np.clip(step_m / _CRUISE_SPEED_M_S, *_QUERY_INTERVALS_S))
    flown_m = np.where(is_jump, 0, np.hypot(*np.diff(position_m, axis=0, prepend=position_m[:1]).T))
    t_s = 100.0 + np.cumsum(np.maximum(interval_s, flown_m / _MAX_SPEED_M_S))  # the mapped way has holes
    return Track(
        t_s=t_s,
        position_m=position_m,
        heading_deg=_make_headings(position_m, is_jump, rng),
        footprints_m=_find_footprints_m(site, other, site_names == site.name, ground_m, rng),
        site_names=site_names,
        ground_m=ground_m,
        is_jump=is_jump,
    )


def _follow_route(kind: str, site: Site, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Return which place of the way each query is at (N,), between two places too, and where it was carried."""
    last, is_jump = len(site.route_m) - 1, np.zeros(QUERIES, bool)
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
        places = places[0] + _fold_back(np.arange(QUERIES), min(QUERIES // 3, last))
    places = _fold_back(places, last)
    if kind == "backwards":
        places = last - places
    elif kind == "jump":
        for start in (QUERIES // 3, 2 * QUERIES // 3):
            places[start:] = _fold_back(places[start:] + last / 2, last)
            is_jump[start] = True
    return places, is_jump


def _fold_back(places: np.ndarray, last: int) -> np.ndarray:
    """Turn back at both ends of the way."""
    return last - abs(places % (2 * last) - last)


def _fly_near_route(site: Site, places: np.ndarray, rng: Rng) -> np.ndarray:
    """Return points beside the mapped way, as far aside as another flight would be."""
    numbers = np.arange(len(site.route_m))
    points = np.column_stack([np.interp(places, numbers, site.route_m[:, axis]) for axis in (0, 1)])
    aside = np.column_stack([make_oscillation(rng, len(places)) for _ in range(2)]) * _ROUTE_OFFSET * site.footprint_m
    still = np.append(False, np.diff(places) == 0)
    for number in np.flatnonzero(still):  # hovering, it stays within a fiftieth of a picture
        aside[number] = aside[number - 1] + rng.normal(0, 0.005, 2) * site.footprint_m
    return site.room.snap(points + aside)


def _cross_site(site: Site, count: int, rng: Rng) -> np.ndarray:
    """Return points on straight lines between random points that can be flown over, far from each other, at the pace of
    the mapped flight."""
    free = site.room.list_points_m()
    step_m = float(np.median(np.hypot(*np.diff(site.route_m, axis=0).T)))
    line = [free[rng.integers(len(free))]]
    while len(line) < count:
        ends = free[rng.integers(len(free), size=20)]
        end = ends[np.argmax(np.hypot(*(ends - line[-1]).T))]
        steps = max(1, round(float(np.hypot(*(end - line[-1]))) / step_m))
        line += [line[-1] + (end - line[-1]) * part for part in np.arange(1, steps + 1) / steps]
    return site.room.snap(np.array(line[:count]))


def _make_headings(position_m: np.ndarray, is_jump: np.ndarray, rng: Rng) -> np.ndarray:
    """Return headings (N,): the nose is turned from the course by an angle of the flight, and swings."""
    step = np.vstack([position_m[1] - position_m[0], np.diff(position_m, axis=0)])
    course, last_deg = np.zeros(len(position_m)), 0.0
    for number, (east, north) in enumerate(step):
        if not is_jump[number] and np.hypot(east, north) > 1.0:
            last_deg = np.degrees(np.arctan2(east, north))
        course[number] = last_deg
    return (course + rng.uniform(0, 360) + 5.0 * make_oscillation(rng, len(position_m))) % 360


def _find_footprints_m(site: Site, other: Site, is_home: np.ndarray, ground_m: np.ndarray, rng: Rng) -> np.ndarray:
    """Return the ground under the pictures: that of the nearest place, since the scale of a mosaic is not the same all
    over, as seen from up to a fifth lower or higher, and lower where there is not so much ground."""
    nearest = np.argmin(((ground_m[:, None] - site.route_m[None]) ** 2).sum(axis=2), axis=1)
    own = np.convolve(np.pad(site.footprints_m[nearest], 2, mode="edge"), np.ones(5) / 5, mode="valid")
    higher = rng.uniform(0.8, 1.2) * (1 + 0.03 * make_oscillation(rng, len(ground_m)))
    widest_m = np.where(is_home, site.widest_m.sample(ground_m), other.widest_m.sample(ground_m))
    return np.minimum(np.where(is_home, own, other.footprint_m) * higher, widest_m)


def simulate_reports(track: Track, site: Site, how: str, rng: Rng) -> list[Vehicle | None]:
    """Return what the autopilot says at each query, of its odometry only: a velocity whose scale, bias and noise are
    wrong, and the position that it leads to. `how` is one of `ODOMETRY`."""
    step_s = np.diff(track.t_s, prepend=track.t_s[0] - 1)[:, None]
    true = np.diff(track.position_m, axis=0, prepend=track.position_m[:1]) / step_s
    true[track.is_jump] = 0
    bias = _VELOCITY_BIAS_M_S * np.column_stack([make_oscillation(rng, len(true)) for _ in range(2)])
    velocity_m_s = true * rng.normal(1, _VELOCITY_SCALE_SD) + bias + rng.normal(0, _VELOCITY_NOISE_M_S, true.shape)
    from_here = len(true) // 3
    velocity_m_s[from_here:] *= {"doubles": 2.0, "halves": 0.5}.get(how, 1.0)
    heading = track.heading_deg + rng.normal(0, _HEADING_SD_DEG) + rng.normal(0, 1, len(true))
    position_m = track.position_m[0] + np.cumsum(velocity_m_s * step_s, axis=0)
    reports: list[Vehicle | None] = []
    for number, t_s in enumerate(track.t_s.tolist()):
        if how == "stops" and number > from_here:
            reports.append(reports[-1])
            continue
        lat_deg, lon_deg = offset_position(*site.origin, *position_m[number].tolist())
        velocity = tuple(velocity_m_s[number].tolist())
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
        reports.append(None if how == "missing" else vehicle)
    return reports


def take_photographs(
    track: Track, photos: Mapping[str, Orthophoto], sites: Mapping[str, Site], rng: Rng
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
    roll, pitch = (_SWAY_DEG * make_oscillation(rng, len(track.position_m)) for _ in range(2))
    for number, name in enumerate(track.site_names):
        pose = CameraPose(
            east_m=0.0,
            north_m=0.0,
            height_m=float(track.footprints_m[number]) * camera.focal_px / camera.width,
            heading_deg=float(track.heading_deg[number]),
            roll_deg=float(roll[number]),
            pitch_deg=float(pitch[number]),
        )
        image = photograph_ground(
            photos[name], sites[name].to_position(track.ground_m[number]), pose, camera, light, rng
        )
        yield image if image is None else cv2.imdecode(cv2.imencode(".jpg", image, quality)[1], cv2.IMREAD_COLOR)
