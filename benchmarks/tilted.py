"""Tilted views over a picture from space of another day: `make tilted`.

The flight of [from_space](from_space.md), by a camera of 28 degrees across that looks ahead of straight down and sees
the same ground, is asked in a map of the raster `before` of sat_marash: every second picture, each alone. Known are
heading, height and, where `tilt` is told, roll and pitch. `level`: the autopilot reports a level airframe, and nobody
the camera's tilt. Pictures that show ground beyond the raster are left out. `within`: share of the accepted whose error
is at most two standard deviations as claimed; `too sure`: those that are not, and claim less than 40 m.

The map is cut at one footprint. Constants of edgevpr were chosen on this set, those of levelling on other views of it.

tilt_ariel: stills of a camera tilted by 45 degrees, of a lens of 70 degrees, by the commands that a user has. The map
has tilt and height, and headings are found by motion; of the queries, `told` says what is known. Errors are by the tag
of the query. The constant for slopes was chosen on it.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import base
import from_space
from base import Row

from edgevpr.frames.positions import read_positions, write_positions

ARIEL = "tilt_ariel"
ARIEL_TILT_DEG = 45.0
ARIEL_FOV_DEG = 70.0
FOV_DEG = 28.0
TILTS_DEG = (0.0, 20.0, 45.0, 60.0)
_ANGLES = {"tilt": {}, "nothing": {"roll_deg": None, "pitch_deg": None}, "level": {"roll_deg": 0.0, "pitch_deg": 0.0}}
_COLUMNS = {
    "tilt": "{tilt:.0f}",
    "told": "{told}",
    **{name: f"{{{name}}}" for name in ("queries", "accepted")},
    "error m": "{error[median_m]} / {error[p90_m]}",
    "claim m": "{claim_m}",
    "within": "{within}",
    "too sure": "{too_sure}",
}


def measure_tilts(folder: Path, work: Path) -> list[Row]:
    path, rows = work / "before.gpkg", []
    size = ("--footprint-m", f"{from_space.FOOTPRINT_M:.1f}", "--spacing-m", f"{from_space.SPACING_M:g}")
    base.run_edgevpr("map", "build", path, "--orthophoto", folder / "raster" / "before.vrt", *size)
    for tilt_deg in TILTS_DEG:
        frames = list(from_space.render_flight(folder / "raster" / "after.vrt", FOV_DEG, tilt_deg))[::2]
        for known, angles in _ANGLES.items():
            changed = (replace(frame, **angles) for frame in frames)
            row = from_space.match_frames(path, changed, "heading, height", FOV_DEG)
            rows.append({"tilt": tilt_deg, "told": known, **row})
            print(rows[-1], flush=True)
    return rows


def measure_ariel(folder: Path, work: Path) -> list[Row]:
    """Map and match the stills of tilt_ariel as a user does."""
    lens = ("--fov-deg", f"{ARIEL_FOV_DEG:g}")
    path, tilted = work / "ariel.gpkg", work / "positions.csv"
    positions = folder / "positions.csv"
    tags = read_positions(positions)
    angles = {"roll_deg": 0.0, "pitch_deg": ARIEL_TILT_DEG}
    write_positions(tilted, {name: replace(tag, height_m=tag.position.alt_m, **angles) for name, tag in tags.items()})
    images = ("--images", folder / "ref", "--positions", tilted)
    base.run_edgevpr("map", "build", path, *images, "--camera", "nadir", *lens)
    rows = []
    options_by_known = {"tilt": (tilted, *lens), "lens": (positions, *lens), "nothing": (positions,)}
    for known, options in options_by_known.items():
        matches = base.run_edgevpr("match", path, "--images", folder / "query", "--positions", *options)
        accepted = [match for match in matches if match["accepted"]]
        claims = [(match["from_gps_tag_m"], match["position"]["accuracy_m"]) for match in accepted]
        counts = {"queries": len(matches), "accepted": len(claims)}
        rows.append({"tilt": ARIEL_TILT_DEG, "told": known, **counts, **from_space.judge_claims(claims)})
    return rows


def main() -> None:
    folder, ariel = base.find_sets(names=[from_space.SET_NAME, ARIEL])
    with tempfile.TemporaryDirectory(prefix="edgevpr-tilted-") as work:
        rows = {"rows": measure_tilts(folder, Path(work)), "ariel": measure_ariel(ariel, Path(work))}
    result = {**base.describe_run(), **rows}
    parts = ["# Tilted views", base.strip_title(__doc__), base.format_table(result["rows"], _COLUMNS), f"## {ARIEL}"]
    parts.append(base.format_table(result["ariel"], _COLUMNS))
    base.write("tilted", result, "\n\n".join([*parts, base.format_origin(result, "make tilted")]))


if __name__ == "__main__":
    base.run(main)
