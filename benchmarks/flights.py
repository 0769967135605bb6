"""Fly fifty flights over real aerial pictures, and match the same pictures in every mode: part of `make results`.

Map and flight share no picture. The map of a set is built from its pictures ref/, at their positions in the mosaic of
the set, and refined. A simulated camera flies over the mosaic of query/, in the same frame: in varied light, swaying by
3 degrees, at any heading, from up to a fifth lower or higher than the map, and lower where there is too little ground.
A picture of which more than a tenth lacks ground is left out. Off the map, a flight is over the mosaic of another set.

Flights follow the mapped route (at the speed of the map, half and twice as fast, backwards, turning back, with a hover,
with stops, carried elsewhere twice, leaving the map and coming back), cross the site, or are over another set
altogether. At the site *rows*, one piece of ground occurs four times. The autopilot reports odometry alone, with errors
of 5 % in scale, of up to 0.5 m/s in velocity (a bias that varies) and of 5 degrees in heading. From a third of the
flight on, the odometry of some flights stops, is wrong by a factor of two, or is not a number; some have none.

A fix is *wrong* where the aircraft is over ground of another set, or where its error exceeds both a quarter of the
longest side of the map's pictures on the ground and three of its claimed standard deviations. It is *far off* where its
error exceeds half that side, whatever it claims. *Lost* is the time over the map without a right fix.

Positions of kite_ochota, aerial_copr and rows have an assumed scale. The truth is that of the mosaic, which drifts: the
scale of aerial_swindale changes by a factor of two from end to end. aerial_brighton has too few pictures to fly over.
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
from edgevpr.core.geodesy import offset_between_m
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
# A fix is wrong beyond both: in longest sides of the map's pictures on the ground, and in claimed standard deviations.
_WRONG_ERROR_SIDES = 0.25
_WRONG_ERROR_SIGMAS = 3.0
_FAR_ERROR_SIDES = 0.5
_MIN_MAPPED_SHARE = 0.5  # of a picture, in pictures of the map: less is not over the map
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
    """Return a recogniser for sequences of `length`; with `tracks_flight`, with the place filter of a live flight."""
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


# The modes of recognition that a flight can use.
MODES: dict[str, Callable[[Technique, PlaceMap, PlaceIndex], Recogniser]] = {
    "filter": partial(_make_recogniser, tracks_flight=True),
    "alone": partial(_make_recogniser),
    "sequence 10": partial(_make_recogniser, length=10),
}


@dataclass(frozen=True, slots=True)
class Flight:
    """A planned flight. `number` seeds it; `other` is the site that it flies over off the map."""

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
    """Fly once, and match each picture in every mode. Returns a row for each query and mode."""
    cv2.setNumThreads(1)
    site, rng = sites[flight.site], np.random.default_rng((_SEED, flight.number))
    track = flight_tracks.make_track(flight.kind, site, sites[flight.other], rng)
    reports = flight_tracks.simulate_reports(track, site, flight.odometry, rng)
    photos = {name: Orthophoto(sites[name].query_mosaic) for name in {flight.site, flight.other}}
    opened = open_recogniser(walks.make_config(map=str(site.place_map)), load_board("this"))
    recognisers = {mode: make(opened.technique, opened.place_map, opened.index) for mode, make in MODES.items()}
    mapped_share = site.covered.sample(track.position_m)
    fields = {"flight": flight.number, "site": site.name, "kind": flight.kind, "odometry": flight.odometry}
    rows = []
    for number, image in enumerate(flight_tracks.take_photographs(track, photos, sites, rng)):
        if image is None:
            continue
        t_s, site_below = float(track.t_s[number]), track.site_names[number]
        east_m, north_m = track.position_m[number].tolist()
        query: Row = {
            **fields,
            "t_s": round(t_s, 2),
            "east_m": round(east_m, 2),
            "north_m": round(north_m, 2),
            "site_below": site_below,
            "is_mapped": bool(site_below == site.name and mapped_share[number] >= _MIN_MAPPED_SHARE),
        }
        frame = walks.make_frame(image, f"{number:03d}", t_s)
        for mode, recogniser in recognisers.items():
            rows.append(query | {"mode": mode} | _score_fix(recogniser.step(frame, reports[number]), site, query))
    for opened_file in (*photos.values(), opened.place_map):
        opened_file.close()  # type: ignore[attr-defined]
    return rows


def _score_fix(event: Recognition, site: Site, query: Row) -> Row:
    """Return the figures of the fix of a query by its true position: `fix` is "right", "wrong" or None."""
    located = event.located
    if located is None:
        return {"fix": None}
    offset_m = np.array(offset_between_m(site.origin, located.position)) - (query["east_m"], query["north_m"])
    error_m, side_m, sd_m = float(np.hypot(*offset_m)), site.footprint_m, located.accuracy_m
    is_foreign = query["site_below"] != site.name
    is_wrong = is_foreign or error_m > max(_WRONG_ERROR_SIDES * side_m, _WRONG_ERROR_SIGMAS * sd_m)
    return {
        "fix": "wrong" if is_wrong else "right",
        "is_far": bool(is_foreign or error_m > _FAR_ERROR_SIDES * side_m),
        "off_m": complex(*offset_m),
        "sd_m": round(sd_m, 2),
        "variances_m2": (located.covariance_m2[0], located.covariance_m2[2]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sites", metavar="A,B", default=",".join(SITES), help="maps to fly with (default: all)")
    args = parser.parse_args()
    base.find_sets(names=[name for name in SITES if name != ROWS_SITE])
    begin_s, rows = time.monotonic(), []
    flights = [flight for flight in plan_flights() if flight.site in args.sites.split(",")]
    with (
        tempfile.TemporaryDirectory(prefix="edgevpr-flights-") as work,
        ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool,
    ):
        prepare = partial(flight_sites.prepare_site, data=base.DATA, work=Path(work))
        sites = {site.name: site for site in pool.map(prepare, SITES)}
        for flight, flight_rows in zip(flights, pool.map(partial(run_flight, sites=sites), flights), strict=True):
            rows += flight_rows
            print(flight, flush=True)
    result = {**base.describe_run(), "took_s": round(time.monotonic() - begin_s), **summarise_modes(rows)}
    base.write("flights", result, format_page(result))


def summarise_modes(rows: Sequence[Row]) -> dict:
    """Return the figures of every mode: of all flights, and by use, site, kind of flight and odometry."""
    groups: dict[str, Callable[[Row], object]] = {
        "all": lambda row: "all",
        "use": lambda row: find_use(row["site"]),
        "site": lambda row: row["site"],
        "kind": lambda row: row["kind"],
        "odometry": lambda row: row["odometry"],
    }
    result: dict[str, dict] = {}
    for group, key in groups.items():
        result[group] = {key(row): {} for row in rows}
        for name, mode in product(result[group], MODES):
            mode_rows = [row for row in rows if key(row) == name and row["mode"] == mode]
            result[group][name][mode] = _compute_figures(mode_rows)
    return result


def _compute_figures(rows: Sequence[Row]) -> dict:
    """Return the figures of the queries of one mode. `within`: shares of errors within 1 and 2 claimed sigmas."""
    flights = {number: [row for row in rows if row["flight"] == number] for number in {row["flight"] for row in rows}}
    over_s, lost_s, gaps = zip(*map(_measure_lost_time, flights.values()), strict=True)
    fixes = [row for row in rows if row["fix"]]
    right = [row for row in fixes if row["fix"] == "right"]
    home_errors = [(row["off_m"], row["variances_m2"]) for row in fixes if row["site_below"] == row["site"]]
    gaps_s = [max(gaps_of_flight) for gaps_of_flight in gaps if gaps_of_flight]
    return {
        "flights": len(flights),
        "queries": len(rows),
        "over_the_map": sum(row["is_mapped"] for row in rows),
        "right": len(right),
        "wrong": len(fixes) - len(right),
        "far_off": sum(row["is_far"] for row in fixes),
        "over_the_map_s": round(sum(over_s)),
        "lost_s": round(sum(lost_s)),
        "longest_gap_s": {"median": round(np.median(gaps_s), 1), "worst": round(max(gaps_s), 1)} if gaps_s else None,
        "error": summarise([row["off_m"] for row in right]) if right else None,
        "claimed_sd_m": round(float(np.median([row["sd_m"] for row in right])), 2) if right else None,
        "within": compute_sigma_shares(*zip(*home_errors, strict=True), more_m2=0.0) if home_errors else None,
    }


def _measure_lost_time(rows: Sequence[Row]) -> tuple[float, float, list[float]]:
    """Return the seconds of one flight over the map, those that ended without a right fix, and, at each query over the
    map, the seconds since the last right fix. Each stretch over the map counts by itself, from its first query."""
    over_s = lost_s = 0.0
    gaps_s: list[float] = []
    last_right_s = None
    for before, row in zip([None, *rows[:-1]], rows, strict=True):
        if not row["is_mapped"]:
            last_right_s = None
            continue
        if last_right_s is None:
            last_right_s = row["t_s"]
        elif before is not None:
            interval_s = row["t_s"] - before["t_s"]
            over_s += interval_s
            lost_s += interval_s * (row["fix"] != "right")
        gaps_s.append(row["t_s"] - last_right_s)
        if row["fix"] == "right":
            last_right_s = row["t_s"]
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
    tuning_sites = [name for name in base.TUNING_SETS if name in result["site"]]
    return f"""# Flights over real aerial pictures

{base.strip_title(__doc__)}

Right, wrong, far off: numbers of fixes. Lost: share of the time over the map. Gap: longest time over the map without a
right fix, median / worst of the flights. Error: median / 95th percentile of right fixes. Within: share of the errors,
per axis, within one and two claimed standard deviations (ideally 0.68 and 0.95), of all fixes over the site itself.

{tables[0]}

Constants of edgevpr were chosen on pictures of {" and ".join(tuning_sites)} (use *tune*), but on none of these flights.

{(chr(10) * 2).join(tables[1:])}

Commit {result["commit"]}, {result["date"]}, {result["machine"]["cpu"]}; {result["took_s"]} s.
`python benchmarks/flights.py` makes this page.
"""


if __name__ == "__main__":
    base.run(main)
