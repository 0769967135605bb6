"""Simulated flights for flights.py: the aircraft's position at each query, the autopilot's reports and the pictures.

Metres are east and north of the middle of the site of the map.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace

import cv2
import numpy as np
from flight_sites import Site

from edgevpr.core.geodesy import move_position
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
# Faults of the odometry, after a third of the flight; a missing one is missing from the beginning.
ODOMETRY = ("good", "good", "stops", "good", "doubles", "good", "halves", "missing", "good", "not a number")
_CRUISE_SPEED_M_S = 10.0
_MAX_SPEED_M_S = 25.0
_QUERY_INTERVALS_S = (1.0, 6.0)  # minimum and maximum
_VELOCITY_BIAS_M_S = 0.5
_VELOCITY_NOISE_M_S = 0.3
_VELOCITY_SCALE_SD = 0.05
_HEADING_SD_DEG = 5.0
_ROUTE_OFFSET = 0.12  # footprints, at most, from the mapped route
_SWAY_DEG = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """One flight of N queries: `t_s`; `position_m` (N, 2) of the aircraft, with `heading_deg` and `footprints_m`, the
    longest side of a picture on the ground; `site_names`: the site whose ground is below, and `ground_m` (N, 2): the
    position in the metres of that site. `is_jump`: it was carried there since the previous query, without odometry."""

    t_s: np.ndarray
    position_m: np.ndarray
    heading_deg: np.ndarray
    footprints_m: np.ndarray
    site_names: np.ndarray
    ground_m: np.ndarray
    is_jump: np.ndarray


def make_track(kind: str, site: Site, other: Site, rng: Rng) -> Track:
    """Make the track of a flight over a site. Off the map, it is over the ground of the `other` site."""
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
            off_map = slice(QUERIES // 3, 2 * QUERIES // 3)
            count = off_map.stop - off_map.start
            outbound_m = _cross_site(other, (count + 1) // 2, rng)
            site_names[off_map] = other.name
            ground_m[off_map] = np.vstack([outbound_m, outbound_m[::-1]])[:count]
            shift_m = (ground_m[off_map] - ground_m[off_map.start]) * site.footprint_m / other.footprint_m
            position_m[off_map] = position_m[off_map.start - 1] + shift_m
    step_m = float(np.median(np.hypot(*np.diff(site.route_m, axis=0).T)))
    interval_s = float(np.clip(step_m / _CRUISE_SPEED_M_S, *_QUERY_INTERVALS_S))
    flown_m = np.where(is_jump, 0, np.hypot(*np.diff(position_m, axis=0, prepend=position_m[:1]).T))
    t_s = 100.0 + np.cumsum(np.maximum(interval_s, flown_m / _MAX_SPEED_M_S))  # long steps: the route has gaps
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
    """Return the place (N,) of the route at each query, fractional between places, and whether it was carried there."""
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
    elif kind == "leave":  # it returns to where it left the map
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
    """Return places within 0 and `last`: reflected at both ends of the route."""
    return last - abs(places % (2 * last) - last)


def _fly_near_route(site: Site, places: np.ndarray, rng: Rng) -> np.ndarray:
    """Return the points (N, 2) of the places, as far from the mapped route as another flight would be."""
    numbers = np.arange(len(site.route_m))
    points_m = np.column_stack([np.interp(places, numbers, site.route_m[:, axis]) for axis in (0, 1)])
    sway = np.column_stack([make_oscillation(rng, len(places)) for _ in range(2)])
    offset_m = sway * _ROUTE_OFFSET * site.footprint_m
    is_hovering = np.append(False, np.diff(places) == 0)
    for number in np.flatnonzero(is_hovering):  # within a fiftieth of a picture
        offset_m[number] = offset_m[number - 1] + rng.normal(0, 0.005, 2) * site.footprint_m
    return site.flyable.snap(points_m + offset_m)


def _cross_site(site: Site, count: int, rng: Rng) -> np.ndarray:
    """Return `count` points (N, 2) on straight lines between random flyable points that are far apart, spaced as in the
    mapped flight."""
    flyable_m = site.flyable.list_points_m()
    step_m = float(np.median(np.hypot(*np.diff(site.route_m, axis=0).T)))
    line = [flyable_m[rng.integers(len(flyable_m))]]
    while len(line) < count:
        ends = flyable_m[rng.integers(len(flyable_m), size=20)]
        end = ends[np.argmax(np.hypot(*(ends - line[-1]).T))]
        steps = max(1, round(float(np.hypot(*(end - line[-1]))) / step_m))
        line += [line[-1] + (end - line[-1]) * fraction for fraction in np.arange(1, steps + 1) / steps]
    return site.flyable.snap(np.array(line[:count]))


def _make_headings(position_m: np.ndarray, is_jump: np.ndarray, rng: Rng) -> np.ndarray:
    """Return headings (N,) in degrees: the course, plus a constant offset of the flight and an oscillation."""
    steps_m = np.vstack([position_m[1] - position_m[0], np.diff(position_m, axis=0)])
    courses_deg, course_deg = np.zeros(len(position_m)), 0.0
    for number, (east, north) in enumerate(steps_m):
        if not is_jump[number] and np.hypot(east, north) > 1.0:
            course_deg = np.degrees(np.arctan2(east, north))
        courses_deg[number] = course_deg
    return (courses_deg + rng.uniform(0, 360) + 5.0 * make_oscillation(rng, len(position_m))) % 360


def _find_footprints_m(site: Site, other: Site, is_home: np.ndarray, ground_m: np.ndarray, rng: Rng) -> np.ndarray:
    """Return the footprints of the pictures (N,): those of the nearest places, since the scale of a mosaic varies, from
    up to a fifth lower or higher, and lower where the mosaic has too little ground."""
    nearest = np.argmin(((ground_m[:, None] - site.route_m[None]) ** 2).sum(axis=2), axis=1)
    home_m = np.convolve(np.pad(site.footprints_m[nearest], 2, mode="edge"), np.ones(5) / 5, mode="valid")
    height_factor = rng.uniform(0.8, 1.2) * (1 + 0.03 * make_oscillation(rng, len(ground_m)))
    max_m = np.where(is_home, site.max_footprint_m.sample(ground_m), other.max_footprint_m.sample(ground_m))
    return np.minimum(np.where(is_home, home_m, other.footprint_m) * height_factor, max_m)


def simulate_reports(track: Track, site: Site, fault: str, rng: Rng) -> list[Vehicle | None]:
    """Return the autopilot's report at each query, by odometry alone: a velocity with errors of scale, bias and noise,
    and the position by that velocity. `fault` is one of `ODOMETRY`."""
    step_s = np.diff(track.t_s, prepend=track.t_s[0] - 1)[:, None]
    true_m_s = np.diff(track.position_m, axis=0, prepend=track.position_m[:1]) / step_s
    true_m_s[track.is_jump] = 0
    bias_m_s = _VELOCITY_BIAS_M_S * np.column_stack([make_oscillation(rng, len(true_m_s)) for _ in range(2)])
    velocity_m_s = true_m_s * rng.normal(1, _VELOCITY_SCALE_SD) + bias_m_s
    velocity_m_s += rng.normal(0, _VELOCITY_NOISE_M_S, true_m_s.shape)
    fault_start = len(true_m_s) // 3
    velocity_m_s[fault_start:] *= {"doubles": 2.0, "halves": 0.5}.get(fault, 1.0)
    heading_deg = track.heading_deg + rng.normal(0, _HEADING_SD_DEG) + rng.normal(0, 1, len(true_m_s))
    position_m = track.position_m[0] + np.cumsum(velocity_m_s * step_s, axis=0)
    reports: list[Vehicle | None] = []
    for number, t_s in enumerate(track.t_s.tolist()):
        if fault == "stops" and number > fault_start:
            reports.append(reports[-1])
            continue
        location = asdict(move_position(site.origin, *position_m[number].tolist(), alt_m=100.0))
        velocity = tuple(velocity_m_s[number].tolist())
        if fault == "not a number" and number >= fault_start:
            velocity = (np.nan, np.nan)
        vehicle = Vehicle(
            **location,
            heading_deg=float(heading_deg[number] % 360),
            t_received_s=t_s - 0.05,
            has_gps=False,
            velocity_m_s=velocity,
        )
        reports.append(None if fault == "missing" else vehicle)
    return reports


def take_photographs(
    track: Track, photos: Mapping[str, Orthophoto], sites: Mapping[str, Site], rng: Rng
) -> Iterator[np.ndarray | None]:
    """Yield the pictures of a flight, uint8 (480, 640, 3) BGR, by a camera and in light that are drawn for it; None
    where too little of a picture has ground."""
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
        position = move_position(sites[name].origin, *track.ground_m[number].tolist())
        image = photograph_ground(photos[name], position, pose, camera, light, rng)
        yield image if image is None else cv2.imdecode(cv2.imencode(".jpg", image, quality)[1], cv2.IMREAD_COLOR)
