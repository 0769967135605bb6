"""Fifty flights over real aerial pictures, every way of recognising asked with the same pictures (`make results`).

Map and flight share no picture. The map of a set is made of its pictures ref/, at their positions in the mosaic of the
set, and refined. A flight is seen by a simulated camera over the mosaic of its pictures query/, in the same frame: in
light of its own, swaying by 3 degrees, turned anyhow, from up to a fifth lower or higher than the map, and lower where
there is too little ground. A picture of which a tenth has none is left out. Where a flight leaves the map, it goes on
over the mosaic of another set.

Flights follow the mapped way (at the pace of the map, half and twice as fast, backwards, turning back, with a hover,
with stops, carried elsewhere twice, leaving the map and coming back), cross it, or are over another set altogether. On
the site *rows* one piece of ground repeats itself four times. The autopilot tells of its odometry only: its scale is
5 % off, its bias wanders by up to 0.5 m/s, the heading is 5 degrees off. From a third on, the odometry of some flights
stops, is wrong by a factor of two, or is not a number; some have none.

A fix is *wrong* where the aircraft is over ground of another set, or farther off than both a quarter of the longest
side of the map's pictures, on the ground, and three standard deviations that the fix claims. It is *far off* where it
is more than half that side off, whatever it claims. Lost are the times over the map without a fix that is right.

Positions of kite_ochota, aerial_copr and rows have an assumed scale. The truth is that of the mosaic, which drifts: of
aerial_swindale its scale changes by a factor of two from one end to the other. aerial_brighton has four pictures to fly
over: too few.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import base
import cv2
import flight_sites
import flight_tracks
import numpy as np
import walks
from base import Row, find_use
from flight_sites import ROWS_SITE, Site
from where import compute_sigma_shares, summarise

from edgevpr.core.contract import Technique
from edgevpr.mapmaking.orthophoto import Orthophoto
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.sequence import make_sequence_search
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.calibration import read_calibration_for
from edgevpr.runtime.recognise.hints import Prior
from edgevpr.runtime.recognise.judge import make_accept_rule
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.runtime.recognise.place_filter import PlaceFilter
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition

_SEED = 2026
# A fix is wrong beyond both: sides of the map's pictures on the ground, and standard deviations that it claims.
_WRONG_ERROR_SIDES = 0.25
_WRONG_ERROR_SIGMAS = 3.0
_FAR_ERROR_SIDES = 0.5
_MIN_MAPPED_SHARE = 0.5  # of a picture over the map is in pictures of the map
_COLUMNS = {
    "flights": "{name}",
    "mode": "{mode}",
    "number": "{flights}",
    **{title.replace("_", " "): f"{{{title}}}" for title in ("queries", "over_the_map", "right", "wrong", "far_off")},
    "lost": "{lost:.0%}",
    "gap s": "{longest_gap_s[median]} / {longest_gap_s[worst]}",
    "error m": "{error[median_m]:.1f} / {error[p95_m]:.1f}",
    "claimed sd m": "{claimed_sd_m:.1f}",
    "within 1, 2 sigma": "{within[one_sigma]:.2f} / {within[two_sigma]:.2f}",
}
SITES = {
    **dict.fromkeys(("aerial_caliterra", "aerial_garfield28", "aerial_swindale", "kite_ochota"), flight_tracks.KINDS),
    "aerial_copr": ("along", "across", "jump", "leave", "foreign"),
    ROWS_SITE: ("along", "backwards", "half speed", "across", "jump"),
}


def _make_recogniser(
    technique: Technique, place_map: PlaceMap, index: PlaceIndex, *, length: int = 1, tracks_flight: bool = False
) -> Recogniser:
    config = walks.make_config()
    reach_m_s = config.match.reach_m_s
    return walks.make_walk(
        place_map,
        index,
        technique,
        rule=make_accept_rule(technique, config.match, length, read_calibration_for(place_map)),
        search=make_sequence_search(length),
        prior=Prior(reach_m_s, technique.spec.heading_within_deg, True) if length == 1 else None,
        min_accuracy_m=config.mavlink.min_accuracy_m,
        place_filter=PlaceFilter(place_map, max_speed_m_s=reach_m_s, is_live=True) if tracks_flight else None,
    )


# The ways of recognising, as a flight has them.
MODES: dict[str, Callable[[Technique, PlaceMap, PlaceIndex], Recogniser]] = {
    "filter": partial(_make_recogniser, tracks_flight=True),
    "alone": partial(_make_recogniser),
    "sequence 10": partial(_make_recogniser, length=10),
}


@dataclass(frozen=True, slots=True)
class Flight:
    """Which flight it is: `number` seeds it, `other` is the site it goes on over where it leaves the map."""

    number: int
    site: str
    kind: str
    odometry: str
    other: str


def plan_flights() -> list[Flight]:
    """Return all flights."""
    flights = []
    for site, kinds in SITES.items():
        others = [name for name in SITES if name != site and not {name, site} <= {"aerial_copr", ROWS_SITE}]
        for kind in kinds:
            number = len(flights)
            odometry = flight_tracks.ODOMETRY[number % len(flight_tracks.ODOMETRY)]
            flights.append(Flight(number, site, kind, odometry, others[number % len(others)]))
    return flights


def run_flight(flight: Flight, sites: dict[str, Site]) -> list[Row]:
    """Fly once, and ask every mode with each picture; return a row for each query and mode."""
    cv2.setNumThreads(1)
    site, rng = sites[flight.site], np.random.default_rng((_SEED, flight.number))
    track = flight_tracks.make_track(flight.kind, site, sites[flight.other], rng)
    reports = flight_tracks.simulate_reports(track, site, flight.odometry, rng)
    photos = {name: Orthophoto(sites[name].query_mosaic) for name in {flight.site, flight.other}}
    opened = open_recogniser(walks.make_config(map=str(site.place_map)), load_board("this"))
    recognisers = {mode: make(opened.technique, opened.place_map, opened.index) for mode, make in MODES.items()}
    share, fields = (
        site.covered.sample(track.position_m),
        {"flight": flight.number, "site": site.name, "kind": flight.kind},
    )
    rows = []
    for number, image in enumerate(flight_tracks.take_photographs(track, photos, sites, rng)):
        if image is None:
            continue
        t_s, (east_m, north_m), ground = (
            float(track.t_s[number]),
            track.position_m[number].tolist(),
            track.site_names[number],
        )
        query: Row = {
            **fields,
            "odometry": flight.odometry,
            "t_s": round(t_s, 2),
            "east_m": round(east_m, 2),
            "north_m": round(north_m, 2),
            "over": ground,
            "is_mapped": bool(ground == site.name and share[number] >= _MIN_MAPPED_SHARE),
        }
        frame = walks.make_frame(image, f"{number:03d}", t_s)
        for mode, recogniser in recognisers.items():
            rows.append(query | {"mode": mode} | _score_fix(recogniser.step(frame, reports[number]), site, query))
    for opened_file in (*photos.values(), opened.place_map):
        opened_file.close()  # type: ignore[attr-defined]
    return rows


def _score_fix(event: Recognition, site: Site, query: Row) -> Row:
    """Return what a query has led to: `fix` is "right", "wrong" or None, with its error by the truth of the query."""
    located = event.located
    if located is None:
        return {"fix": None}
    off_m = site.to_offset_m(located.position) - (query["east_m"], query["north_m"])
    error_m, side_m, sd_m = float(np.hypot(*off_m)), site.footprint_m, located.accuracy_m
    foreign = query["over"] != site.name
    is_wrong = foreign or error_m > max(_WRONG_ERROR_SIDES * side_m, _WRONG_ERROR_SIGMAS * sd_m)
    return {
        "fix": "wrong" if is_wrong else "right",
        "is_far": bool(foreign or error_m > _FAR_ERROR_SIDES * side_m),
        "off_m": complex(*off_m),
        "sd_m": round(sd_m, 2),
        "variances_m2": (located.covariance_m2[0], located.covariance_m2[2]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sites", metavar="A,B", default=",".join(SITES), help="whose maps are flown with (all)")
    args = parser.parse_args()
    base.find_sets(names=[name for name in SITES if name != ROWS_SITE])
    began_s, rows = time.monotonic(), []
    flights = [flight for flight in plan_flights() if flight.site in args.sites.split(",")]
    with (
        tempfile.TemporaryDirectory(prefix="edgevpr-flights-") as work,
        ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool,
    ):
        prepare = partial(flight_sites.prepare_site, data=base.DATA, work=Path(work))
        sites = {site.name: site for site in pool.map(prepare, SITES)}
        for flight, new in zip(flights, pool.map(partial(run_flight, sites=sites), flights), strict=True):
            rows += new
            print(flight, flush=True)
    result = {**base.describe_run(), "took_s": round(time.monotonic() - began_s), **summarise_modes(rows, list(MODES))}
    base.write("flights", result, format_page(result))


def summarise_modes(rows: Sequence[Row], modes: Sequence[str]) -> dict:
    """Return the figures of every mode, by what the flights have in common."""
    groups: dict[str, Callable[[Row], object]] = {
        "all": lambda row: "all",
        "use": lambda row: find_use(row["site"]),
        "site": lambda row: row["site"],
        "kind": lambda row: row["kind"],
        "odometry": lambda row: row["odometry"],
    }
    result: dict[str, dict] = {}
    for group, key in groups.items():
        names = dict.fromkeys(key(row) for row in rows)
        result[group] = {name: {} for name in names}
        for name, mode in product(names, modes):
            own = [row for row in rows if key(row) == name and row["mode"] == mode]
            result[group][name][mode] = _compute_figures(own)
    return result


def _compute_figures(rows: Sequence[Row]) -> dict:
    flights = {number: [row for row in rows if row["flight"] == number] for number in {row["flight"] for row in rows}}
    over_s, lost_s, gaps = zip(*map(_measure_lost_time, flights.values()), strict=True)
    fixes = [row for row in rows if row["fix"]]
    right = [row for row in fixes if row["fix"] == "right"]
    own = [(row["off_m"], row["variances_m2"]) for row in fixes if row["over"] == row["site"]]
    gaps_s = [max(gaps_of_flight) for gaps_of_flight in gaps if gaps_of_flight]
    return {
        "flights": len(flights),
        "queries": len(rows),
        "over_the_map": sum(row["is_mapped"] for row in rows),
        "right": len(right),
        "wrong": len(fixes) - len(right),
        "far_off": sum(row["is_far"] for row in fixes),
        "wrong_over_other_ground": sum(row["over"] != row["site"] for row in fixes),
        "over_the_map_s": round(sum(over_s)),
        "lost_s": round(sum(lost_s)),
        "longest_gap_s": {"median": round(np.median(gaps_s), 1), "worst": round(max(gaps_s), 1)} if gaps_s else None,
        "error": summarise([row["off_m"] for row in right]) if right else None,
        "claimed_sd_m": round(float(np.median([row["sd_m"] for row in right])), 2) if right else None,
        "within": compute_sigma_shares(*zip(*own, strict=True), more_m2=0.0) if own else None,
    }


def _measure_lost_time(rows: Sequence[Row]) -> tuple[float, float, list[float]]:
    """Return, of one flight, the seconds over the map, those of queries without a fix that is right, and the times
    between one such fix, or the begin, and the next, or the end. Each stretch over the map counts by itself."""
    over_s = lost_s = 0.0
    gaps_s: list[float] = []
    since_s = None
    for before, row in zip([None, *rows[:-1]], rows, strict=True):
        if not row["is_mapped"]:
            since_s = None
            continue
        if since_s is None:
            since_s = row["t_s"]
        elif before is not None:
            took_s = row["t_s"] - before["t_s"]
            over_s += took_s
            lost_s += took_s * (row["fix"] != "right")
        gaps_s.append(row["t_s"] - since_s)
        if row["fix"] == "right":
            since_s = row["t_s"]
    return over_s, lost_s, gaps_s


def format_page(result: Row) -> str:
    """Return the results as Markdown."""
    tables = []
    for group in ("all", "use", "site", "kind", "odometry"):
        rows = [
            figures | {"name": name, "mode": mode, "lost": over_s and figures["lost_s"] / over_s}
            for name, modes in result[group].items()
            for mode, figures in modes.items()
            for over_s in [figures["over_the_map_s"] or None]
        ]
        tables.append((f"By {group}:\n\n" if group != "all" else "") + base.format_table(rows, _COLUMNS))
    return f"""# Flights over real aerial pictures

{base.strip_title(__doc__)}

Right, wrong, far off: fixes. Lost: share of the time over the map. Gap: the longest without a right fix over the map,
median and worst of the flights. Errors: median / 95th percentile of right fixes. Within: shares of errors, axis by
axis, within one and two standard deviations that the fix claims (asked 0.68, 0.95), of all fixes over the site's own
ground.

{tables[0]}

Constants of edgevpr were chosen on {" and ".join(name for name in base.TUNING_SETS if name in result["site"])} (use
*tune*), of the sites here; on none of these flights.

{(chr(10) * 2).join(tables[1:])}

Commit {result["commit"]}, {result["date"]}, {result["machine"]["cpu"]}; {result["took_s"]} s.
`python benchmarks/flights.py` makes this page.
"""


if __name__ == "__main__":
    base.run(main)
