"""Where exactly: how far fixes are from the truth, before and after the map is refined (part of `make results`).

The sets from the air with positions, each mapped and matched by the commands that a user has. Truths:

* *pairs*: every registered pair of pictures (pairs_overlap.csv: local features and homographies, made with the sets)
  and all GPS tags in one pose graph, in metres. A fix is compared with it as it lies to the four nearest pictures of
  the map, so that what both have from the same tags does not count.
* *mosaic*: mosaic_positions.csv, laid over the refined map by one similarity. It has no scale of its own, and drifts:
  of aerial_swindale its scale changes by a factor of two from one end to the other.
* *GPS*: the tag of the query, which is itself some metres off.
* *true*: of generated flights, whose cameras are where they say, with 5 m of noise on the positions of the map (in one
  axis). Only this truth is that of the aircraft, and not of the middle of its picture.

Writes where.json, where.md, and the pictures where_maps.png and where_overlays.png into benchmarks/results/.
"""

import csv
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import run_sets

from edgevpr.core.geodesy import moved, offset_m
from edgevpr.core.text import markdown
from edgevpr.core.types import Place
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import read_positions
from edgevpr.lab.simulate.flight import fly_and_write
from edgevpr.mapmaking.graph import Solved, Ties, solve
from edgevpr.places.mapfile import PlaceMap

SETS = ("aerial_caliterra", "aerial_garfield28", "aerial_swindale", "aerial_brighton")
TUNED_ON = ("aerial_caliterra", "aerial_garfield28")
_PAIR_SD = (0.01, 0.05)  # of a registered pair: of the step, as a share of the longest side, and of the log
_NEAREST = 4
NADIR = ("--technique", "cohog", "--camera", "nadir")
SEEDS, NOISE_M = (11, 12, 13), 5.0


@dataclass(frozen=True, slots=True)
class Set:
    """A set in metres, complex (east + i north) from its first tag: `tags` and, of those in its registered pairs,
    `truth` by name; `mosaic` in its pixels, y up, of the largest component."""

    name: str
    folder: Path
    origin: tuple[float, float]
    tags: dict[str, complex]
    truth: dict[str, complex]
    mosaic: dict[str, complex]

    def to_metres(self, lat_deg: float, lon_deg: float) -> complex:
        """Return a position in metres."""
        return complex(*offset_m(*self.origin, lat_deg, lon_deg))


def load(folder: Path) -> Set:
    """Read a set, and solve its truth."""
    found = {name: tag.position for name, tag in read_positions(folder / "positions.csv").items() if tag.position}
    first = next(iter(found.values()))
    empty = Set(folder.name, folder, (first.lat_deg, first.lon_deg), {}, {}, {})
    tags = {name: empty.to_metres(each.lat_deg, each.lon_deg) for name, each in found.items()}
    names = sorted(tags)
    solved = _registered(folder, names, tags)
    largest = np.bincount(solved.component).argmax()
    truth = {name: complex(solved.position[at]) for at, name in enumerate(names) if solved.component[at] == largest}
    with open(folder / "mosaic_positions.csv", newline="") as handle:
        rows = list(csv.DictReader(handle))
    components = [row["component"] for row in rows]
    of = max(set(components), key=components.count)
    mosaic = {row["file"]: complex(float(row["x_px"]), -float(row["y_px"])) for row in rows if row["component"] == of}
    return Set(folder.name, folder, empty.origin, tags, truth, mosaic)


def _registered(folder: Path, names: list[str], tags: dict[str, complex]) -> Solved:
    number = {name: at for at, name in enumerate(names)}
    rejected_path = folder / "rejected_pairs.csv"
    rejected = set()
    if rejected_path.is_file():
        with open(rejected_path, newline="") as handle:
            rejected = {(row["file_a"], row["file_b"]) for row in csv.DictReader(handle)}
    with open(folder / "pairs_overlap.csv", newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if (row["file_a"], row["file_b"]) not in rejected]
    longest = {name: max(picture(folder, name).shape[:2]) for name in names}
    step = [complex(float(row["dx_px"]), -float(row["dy_px"])) / longest[row["file_b"]] for row in rows]
    turn = [complex(np.log(float(row["scale"])), -np.radians(float(row["rotation_deg"]))) for row in rows]
    step_sd, turn_sd = (np.full(len(rows), each) for each in _PAIR_SD)
    query, place = (np.array([number[row[key]] for row in rows]) for key in ("file_a", "file_b"))
    ties = Ties(query=query, place=place, step=np.array(step), turn=np.array(turn), step_sd=step_sd, turn_sd=turn_sd)
    return solve(np.array([tags[name] for name in names]), np.full(len(names), np.nan), ties)


def picture(folder: Path, name: str) -> np.ndarray:
    """Read a picture of a set, of the map or a query."""
    return read_image(next(folder / part / name for part in ("ref", "query") if (folder / part / name).is_file()))


def measure(folder: Path, work: Path) -> tuple[dict, list[dict], dict[str, Place], Set]:
    """Map and match a set, as it is and refined."""
    of, matches = load(folder), {}
    for how, flags in (("before", ["--no-refine"]), ("after", [])):
        path = work / f"{folder.name}_{how}.gpkg"
        built = run_sets.edgevpr("map", "build", str(path), "--images", str(folder / "ref"), *NADIR, *flags, "--json")
        matches[how] = run_sets.edgevpr("match", str(path), "--images", str(folder / "query"), "--json")
    with PlaceMap.open(path) as place_map:
        places = {place.source_image: place for place in place_map.places()}
    here = {name: of.to_metres(place.position.lat_deg, place.position.lon_deg) for name, place in places.items()}
    lie = [name for name, place in places.items() if place.pose]
    row = {
        "set": folder.name,
        "use": "tune" if folder.name in TUNED_ON else "report",
        "places": len(places),
        "refined": built["refined"],
        "spacing_m": float(np.median(abs(np.diff([of.tags[name] for name in places])))),
        "queries": len(matches["after"]),
        "accepted": {how: sum(each["accepted"] for each in found) for how, found in matches.items()},
    }
    common = [name for name in lie if name in of.mosaic]
    scale, offset = np.polyfit([of.mosaic[name] for name in common], [here[name] for name in common], 1)
    errors: dict[str, dict[str, list[complex]]] = {}
    expected: dict[str, list[tuple[float, float]]] = {}
    for how, found in matches.items():
        for each in found:
            name, located = each["query"], each["located"]
            if not each["accepted"] or located is None or (how == "after" and not _is_laid(each, places)):
                continue
            fix = of.to_metres(located["lat_deg"], located["lon_deg"])
            truths = {"GPS": of.tags.get(name)}
            if name in of.mosaic:
                truths["mosaic"] = scale * of.mosaic[name] + offset
            near = sorted(
                (ref for ref in lie if ref in of.truth), key=lambda ref: abs(of.truth[ref] - of.truth.get(name, 0))
            )
            if name in of.truth and len(near) >= _NEAREST:
                beside = near[:_NEAREST]
                truths["pairs"] = of.truth[name] + np.mean([here[ref] - of.truth[ref] for ref in beside])
            for truth, at in truths.items():
                errors.setdefault(truth, {}).setdefault(how, []).append(fix - at)
                if how == "after":
                    var_east, _, var_north = located["covariance_m2"]
                    expected.setdefault(truth, []).append((var_east, var_north))
    row["errors"] = {truth: {how: spread(values) for how, values in by.items()} for truth, by in errors.items()}
    tag_var = (row["refined"]["recorded_sd_m"] or 0.0) ** 2
    row["within"] = {
        truth: honest(errors[truth]["after"], expected[truth], tag_var if truth == "GPS" else 0.0) for truth in expected
    }
    return row, matches["after"], places, of


def generated(work: Path, what: str, lens: tuple[str, ...]) -> dict:
    """Map and match generated flights of several seeds, with noise on the positions of the map; with a `lens`, attitude
    and height are used."""
    errors: dict[str, list[complex]] = {"before": [], "after": []}
    variances, queries, accepted = [], 0, {"before": 0, "after": 0}
    for seed in SEEDS:
        folder, rng = work / f"seed{seed}{len(lens)}", np.random.default_rng(seed)
        for which in ("map", "query"):
            fly_and_write(folder / which, which, seed)
        with open(folder / "map" / "positions.csv", newline="") as handle:
            rows = list(csv.DictReader(handle))
        with open(folder / "map" / "positions.csv", "w", newline="") as handle:
            table = csv.DictWriter(handle, rows[0])
            table.writeheader()
            for row in rows:
                at = moved(float(row["lat"]), float(row["lon"]), *rng.normal(0, NOISE_M, 2).tolist())
                table.writerow(row | dict(zip(("lat", "lon"), at, strict=True)))
        true = {name: tag.position for name, tag in read_positions(folder / "query" / "positions.csv").items()}
        for how, flags in (("before", ["--no-refine"]), ("after", [])):
            path = folder / f"{how}.gpkg"
            images, asked = (str(folder / which / "images") for which in ("map", "query"))
            run_sets.edgevpr("map", "build", str(path), "--images", images, *NADIR, *lens, *flags, "--json")
            for match in run_sets.edgevpr("match", str(path), "--images", asked, *lens, "--json"):
                queries += how == "after"
                if not match["accepted"]:
                    continue
                accepted[how] += 1
                here, where = true[match["query"]], match["located"]
                off_m = offset_m(here.lat_deg, here.lon_deg, where["lat_deg"], where["lon_deg"])
                errors[how].append(complex(*off_m))
                if how == "after":
                    variances.append((where["covariance_m2"][0], where["covariance_m2"][2]))
    return {
        "set": f"{len(SEEDS)} generated flights, {what}",
        "use": "report",
        "spacing_m": 21.0,
        "queries": queries,
        "accepted": accepted,
        "errors": {"true": {how: spread(values) for how, values in errors.items()}},
        "within": {"true": honest(errors["after"], variances, 0.0)},
    }


def _is_laid(match: dict, places: dict[str, Place]) -> bool:
    return places[match["reference_image"]].pose is not None


def spread(errors: list[complex]) -> dict:
    """Return count, median, 95th percentile and largest of errors."""
    away = np.abs(errors)
    return {
        "count": len(away),
        "median_m": round(float(np.median(away)), 2),
        "p95_m": round(float(np.percentile(away, 95)), 2),
        "worst_m": round(float(away.max()), 2),
    }


def honest(errors: list[complex], variances: list[tuple[float, float]], more_m2: float) -> dict:
    """Return which shares of errors, axis by axis, are within one and two standard deviations; `more_m2` is the
    variance of the truth."""
    off = np.array([(each.real, each.imag) for each in errors])
    ratio = abs(off) / np.sqrt(np.array(variances) + more_m2)
    return {"one_sigma": round(float((ratio < 1).mean()), 3), "two_sigma": round(float((ratio < 2).mean()), 3)}


def main() -> int:
    data = run_sets.REPOSITORY.parent / "shared" / "data"
    folders = run_sets.find_sets(data, list(SETS))
    rows, shown = [], []
    with tempfile.TemporaryDirectory(prefix="edgevpr-where-") as work:
        for folder in folders:
            row, matches, places, of = measure(folder, Path(work))
            rows.append(row)
            shown.append((of, places, matches))
            print(json.dumps(row), flush=True)
        rows.append(generated(Path(work), "attitude unknown", ()))
        rows.append(generated(Path(work), "attitude known", ("--fov-deg", "66")))
    (run_sets.RESULTS / "where.json").write_text(json.dumps({**run_sets.made_by(), "sets": rows}, indent=1) + "\n")
    (run_sets.RESULTS / "where.md").write_text(page(rows))
    draw_maps(shown, run_sets.RESULTS / "where_maps.png")
    draw_overlays(shown, run_sets.RESULTS / "where_overlays.png")
    return 0


def page(rows: list[dict]) -> str:
    """Return the results as Markdown."""
    made = run_sets.made_by()
    table = []
    for row in rows:
        for truth, by in sorted(row["errors"].items()):
            cells = [
                f"{by[how]['median_m']:.1f} / {by[how]['p95_m']:.1f}" if how in by else "-"
                for how in ("before", "after")
            ]
            within = row["within"].get(truth)
            share = f"{within['one_sigma']:.2f} / {within['two_sigma']:.2f}" if within else "-"
            count = by["after"]["count"] if "after" in by else 0
            table.append([row["set"], row["use"], f"{row['spacing_m']:.0f}", truth, str(count), *cells, share])
    head = ("set", "use", "spacing m", "truth", "fixes", "before m", "after m", "within 1, 2 sigma")
    return f"""# Where exactly

{__doc__.partition(chr(10) * 2)[2].partition("Writes where.json")[0].strip()}

Errors are median / 95th percentile of accepted matches: before refining, of the place's own position; after it, of the
fix. Within: shares of errors, axis by axis, within one and two standard deviations of the fix (asked: .68 and .95);
against GPS with the scatter of the tags, which refining has estimated, added.

{markdown(head, table)}

Commit {made["commit"]}, {made["date"]}, {made["machine"]["cpu"]}.
`python benchmarks/where.py` makes this page. Constants were chosen on the sets marked *tune*.

![maps](where_maps.png)

![overlays](where_overlays.png)
"""


def draw_maps(shown: list, path: Path) -> None:
    """Draw each map as it was recorded and refined, with the truth of its pairs."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 2, figsize=(14, 14))
    for axis, (of, places, _) in zip(axes.flat, shown, strict=True):
        lie = {name: place for name, place in places.items() if place.pose}
        here = {name: of.to_metres(each.position.lat_deg, each.position.lon_deg) for name, each in places.items()}
        both = [name for name in lie if name in of.truth]
        offset = np.mean([here[name] - of.truth[name] for name in both])
        for name, at in here.items():
            was = of.tags[name]
            axis.plot([was.real, at.real], [was.imag, at.imag], color="0.75", lw=0.8, zorder=1)
        axis.plot(*_xy([of.tags[name] for name in places]), "o", color="#c05030", ms=4, label="as recorded")
        axis.plot(*_xy([here[name] for name in lie]), "o", color="#2060c0", ms=5, label="refined")
        axis.plot(*_xy([of.truth[name] + offset for name in both]), "+", color="black", ms=9, label="registered pairs")
        axis.set(title=f"{of.name}: {len(lie)} of {len(places)} places refined", xlabel="east, m", ylabel="north, m")
        axis.axis("equal")
        axis.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=70)


def _xy(points: list[complex]) -> tuple[list[float], list[float]]:
    return [each.real for each in points], [each.imag for each in points]


def draw_overlays(shown: list, path: Path) -> None:
    """Lay queries over the places that were found, by the transform of the match: red is the place, cyan the query."""
    rows = []
    for of, _, matches in shown:
        found = [each for each in matches if each["shift_cells"] is not None]
        sure = sorted((each for each in found if each["accepted"]), key=lambda each: each["score"])
        unsure = sorted((each for each in found if not each["accepted"]), key=lambda each: -each["score"])
        chosen = [*sure[-1:], *sure[len(sure) // 2 : len(sure) // 2 + 1], *sure[:1], *unsure[:1]]
        tiles = [laid_over(of.folder, each) for each in chosen]
        rows.append(np.hstack([*tiles, *[np.zeros_like(tiles[0])] * (4 - len(tiles))]))
    cv2.imwrite(str(path), np.vstack(rows), [cv2.IMWRITE_PNG_COMPRESSION, 9])


def laid_over(folder: Path, match: dict, side: int = 320, cells: int = 32) -> np.ndarray:
    """Lay the query of a match over its place: uint8 (side, side, 3)."""
    place, query = (_square(picture(folder, match[key]), side) for key in ("reference_image", "query"))
    scale = match.get("height_ratio") or 1.0
    middle = (side - 1) / 2
    turn = cv2.getRotationMatrix2D((middle, middle), -match["rotation_deg"], scale)
    turn[:, 2] += np.array(match["shift_cells"]) * side / cells
    query = cv2.warpAffine(query, turn, (side, side))
    both = np.dstack([query, query, place])
    text = f"{folder.name}, {'accepted' if match['accepted'] else 'not accepted'}, {match['score']:.2f}"
    cv2.putText(both, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return both


def _square(image: np.ndarray, side: int) -> np.ndarray:
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    height, width = grey.shape
    longest = max(height, width)
    square = np.zeros((longest, longest), np.uint8)
    square[(longest - height) // 2 :, (longest - width) // 2 :][:height, :width] = grey
    return cv2.equalizeHist(cv2.resize(square, (side, side), interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    sys.exit(main())
