"""Tilted views over a satellite picture of another day: `make tilted`.

The flight of [from_space](from_space.md), with a camera of 28 degrees field of view that is tilted forward and sees the
same ground, is matched in a map of the raster `before` of sat_marash: every second picture, each without the others.
Heading and height are known; roll and pitch only with `tilt`. With `level`, the autopilot reports a level airframe, and
the camera's tilt is unknown. Pictures that show ground beyond the raster are left out. `within`: share of the accepted
fixes whose error is at most two claimed standard deviations; `overconfident`: fixes beyond that which claim under 40 m.

The map has one footprint. Constants of edgevpr were chosen on this set, those of levelling on other views of it.

tilt_ariel: stills of a camera with a lens of 70 degrees, tilted by 45 degrees, mapped and matched by the commands of a
user. The map has tilt and height, and headings come from motion; `known` says what is known of the queries. Errors are
relative to the GPS tag of the query. The constant for slopes was chosen on this set.
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
TILTS_DEG = (0.0, 10.0, 20.0, 45.0, 60.0)
_ANGLES = {"tilt": {}, "nothing": {"roll_deg": None, "pitch_deg": None}, "level": {"roll_deg": 0.0, "pitch_deg": 0.0}}
_COLUMNS = {
    "tilt": "{tilt:.0f}",
    "known": "{told}",
    **{name: f"{{{name}}}" for name in ("queries", "accepted")},
    "error m": "{error[median_m]} / {error[p90_m]}",
    "claim m": "{claim_m}",
    "within": "{within}",
    "overconfident": "{too_sure}",
}


def measure_tilts(folder: Path, work: Path) -> list[Row]:
    """Return a row for each tilt of the camera and each of the known angles over the satellite picture of `folder`."""
    path, rows = work / "before.gpkg", []
    size = ("--footprint-m", f"{from_space.FOOTPRINT_M:.1f}", "--spacing-m", f"{from_space.SPACING_M:g}")
    base.run_edgevpr("map", "build", path, "--orthophoto", folder / "raster" / "before.vrt", *size)
    for tilt_deg in TILTS_DEG:
        frames = list(from_space.render_flight(folder / "raster" / "after.vrt", FOV_DEG, tilt_deg))[::2]
        for known, angles in _ANGLES.items():
            frames_with_angles = (replace(frame, **angles) for frame in frames)
            row = from_space.match_frames(path, frames_with_angles, "heading, height", FOV_DEG)
            rows.append({"tilt": tilt_deg, "told": known, **row})
            print(rows[-1], flush=True)
    return rows


def measure_ariel(folder: Path, work: Path) -> list[Row]:
    """Map and match the stills of tilt_ariel with the commands of a user, with a row for each prior."""
    lens = ("--fov-deg", f"{ARIEL_FOV_DEG:g}")
    path, positions_with_tilt = work / "ariel.gpkg", work / "positions.csv"
    positions = folder / "positions.csv"
    tags = read_positions(positions)
    angles = {"roll_deg": 0.0, "pitch_deg": ARIEL_TILT_DEG}
    tilted_tags = {name: replace(tag, height_m=tag.position.alt_m, **angles) for name, tag in tags.items()}
    write_positions(positions_with_tilt, tilted_tags)
    images = ("--images", folder / "ref", "--positions", positions_with_tilt)
    base.run_edgevpr("map", "build", path, *images, "--camera", "nadir", *lens)
    rows = []
    options_by_known = {"tilt": (positions_with_tilt, *lens), "lens": (positions, *lens), "nothing": (positions,)}
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
