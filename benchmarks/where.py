"""Where exactly: errors of fixes, before and after the map is refined (part of `make results`).

Each aerial set with positions is mapped and matched by the commands of a user. There are three kinds of truth:

* *pairs*: one pose graph of all registered pairs of pictures (pairs_overlap.csv, from local features and homographies,
  made with the sets) and all GPS tags, in metres. A fix is compared with it relative to the four nearest pictures of
  the map, so that errors of the GPS tags that both share do not count.
* *GPS*: the tag of the query, which has an error of some metres itself.
* *true*: the exact position in generated flights, with 5 m of noise (per axis) on the positions of the map. Only this
  truth is the position of the aircraft; the others are of the centre of the picture.

Writes where.json, where.md and the picture where_maps.png into benchmarks/results/.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import base
import numpy as np
from base import RESULTS, Row

from edgevpr.core.geodesy import offset_m, offset_position
from edgevpr.core.types import Place, Position
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import read_positions, write_positions
from edgevpr.lab.simulate.generated import write_generated_flight
from edgevpr.mapmaking.graph import GraphSolution, Ties, solve_graph
from edgevpr.places.mapfile import PlaceMap

SETS = ("aerial_caliterra", "aerial_garfield28", "aerial_swindale", "aerial_brighton")
_PAIR_SD = (0.01, 0.05)  # of a registered pair: shift, as a share of the longest side; log of scale and rotation
_NEAREST_PICTURES = 4
ON_GIMBAL = ("aerial_brighton",)  # says its README
NADIR_FLAGS = ("--technique", "cohog", "--camera", "nadir")
REFINE_FLAGS = {"before": ("--no-refine",), "after": ()}
SEEDS = (11, 12, 13)
NOISE_SD_M = 5.0  # of the positions of the map, per axis
_COLUMNS = {
    "set": "{set}",
    "use": "{use}",
    "spacing m": "{spacing_m:.0f}",
    "truth": "{truth}",
    "fixes": "{after[count]}",
    "before m": "{before[median_m]:.1f} / {before[p95_m]:.1f}",
    "after m": "{after[median_m]:.1f} / {after[p95_m]:.1f}",
    "within 1, 2 sigma": "{within[one_sigma]:.2f} / {within[two_sigma]:.2f}",
}


@dataclass(frozen=True, slots=True)
class AerialSet:
    """The pictures of a set in metres, complex (east + i north) from the first tag (`origin`), by name: the GPS `tags`,
    and the `truth` of the largest component of registered pairs."""

    name: str
    folder: Path
    origin: tuple[float, float]
    tags: dict[str, complex]
    truth: dict[str, complex]

    def to_metres(self, position: Position) -> complex:
        """Return a position as east + i north, in metres from the origin."""
        return complex(*offset_m(*self.origin, position.lat_deg, position.lon_deg))


def load_set(folder: Path) -> AerialSet:
    """Read a set and solve the pose graph of its registered pairs."""
    positions = {name: tag.position for name, tag in read_positions(folder / "positions.csv").items() if tag.position}
    first = next(iter(positions.values()))
    untagged = AerialSet(folder.name, folder, (first.lat_deg, first.lon_deg), {}, {})
    tags = {name: untagged.to_metres(position) for name, position in positions.items()}
    names = sorted(tags)
    solved = _solve_pairs(folder, names, tags)
    largest = np.bincount(solved.component).argmax()
    truth = {names[slot]: complex(solved.position[slot]) for slot in np.flatnonzero(solved.component == largest)}
    return AerialSet(folder.name, folder, untagged.origin, tags, truth)


def _solve_pairs(folder: Path, names: list[str], tags: dict[str, complex]) -> GraphSolution:
    """Solve the pose graph of the registered pairs that were not rejected, and of the GPS tags of all `names`."""
    slots = {name: slot for slot, name in enumerate(names)}
    rejected_path = folder / "rejected_pairs.csv"
    rejected_rows = base.read_csv(rejected_path) if rejected_path.is_file() else []
    rejected = {(row["file_a"], row["file_b"]) for row in rejected_rows}
    pairs = base.read_csv(folder / "pairs_overlap.csv")
    rows = [row for row in pairs if (row["file_a"], row["file_b"]) not in rejected]
    longest = {name: max(read_set_image(folder, name).shape[:2]) for name in names}
    step = [complex(float(row["dx_px"]), -float(row["dy_px"])) / longest[row["file_b"]] for row in rows]
    turn = [complex(np.log(float(row["scale"])), -np.radians(float(row["rotation_deg"]))) for row in rows]
    step_sd, turn_sd = (np.full(len(rows), sd) for sd in _PAIR_SD)
    query, place = (np.array([slots[row[key]] for row in rows]) for key in ("file_a", "file_b"))
    ties = Ties(query=query, place=place, step=np.array(step), turn=np.array(turn), step_sd=step_sd, turn_sd=turn_sd)
    return solve_graph(np.array([tags[name] for name in names]), ties)


def read_set_image(folder: Path, name: str) -> np.ndarray:
    """Read a picture of a set, from ref/ or query/."""
    return read_image(next(folder / part / name for part in ("ref", "query") if (folder / part / name).is_file()))


def measure_set(folder: Path, work: Path) -> tuple[Row, dict[str, Place], AerialSet]:
    """Map and match a set with and without refining; return its row, the refined places by picture, and the set."""
    site, matches, config = load_set(folder), {}, work / "config.yaml"
    config.write_text(f"source: {{gimbal: {str(folder.name in ON_GIMBAL).lower()}}}")
    for stage, flags in REFINE_FLAGS.items():
        path = work / f"{folder.name}_{stage}.gpkg"
        images, setup = folder / "ref", ("--config", config)
        built = base.run_edgevpr("map", "build", path, "--images", images, *NADIR_FLAGS, *flags, *setup)
        matches[stage] = base.run_edgevpr("match", path, "--images", folder / "query", *setup)
    with PlaceMap.open(path) as place_map:
        places = {place.source_image: place for place in place_map.read_places()}
    errors, variances = _compute_errors(site, matches, places)
    tag_var = (built["refined"]["recorded_sd_m"] or 0.0) ** 2
    row = {
        "set": folder.name,
        "use": base.find_use(folder.name),
        "spacing_m": float(np.median(abs(np.diff([site.tags[name] for name in places])))),
        "errors": {truth: {key: summarise(group) for key, group in stages.items()} for truth, stages in errors.items()},
        "within": {
            truth: compute_sigma_shares(errors[truth]["after"], truth_variances, tag_var if truth == "GPS" else 0.0)
            for truth, truth_variances in variances.items()
        },
    }
    return row, places, site


def _compute_errors(site: AerialSet, matches: dict[str, list[Row]], places: dict[str, Place]) -> tuple[dict, dict]:
    """Return the errors of fixes (complex, metres) by kind of truth and by stage of the map (before or after refining),
    and the variances (east, north) of the fixes after refining, by kind of truth."""
    places_m = {name: site.to_metres(place.position) for name, place in places.items()}
    refined = [name for name, place in places.items() if place.pose and name in site.truth]
    errors: dict[str, dict[str, list[complex]]] = {}
    variances: dict[str, list[tuple[float, float]]] = {}
    for stage, match in ((stage, match) for stage, stage_matches in matches.items() for match in stage_matches):
        name, fix = match["query"], match["position"]
        if fix is None or (stage == "after" and places[match["place"]["image"]].pose is None):
            continue
        truths = {"GPS": site.tags.get(name)}
        near = sorted(refined, key=lambda ref: abs(site.truth[ref] - site.truth.get(name, 0)))
        if name in site.truth and len(near) >= _NEAREST_PICTURES:
            truths["pairs"] = site.truth[name] + np.mean(
                [places_m[ref] - site.truth[ref] for ref in near[:_NEAREST_PICTURES]]
            )
        for truth, true_m in truths.items():
            fix_m = site.to_metres(Position(fix["lat_deg"], fix["lon_deg"]))
            errors.setdefault(truth, {}).setdefault(stage, []).append(fix_m - true_m)
            if stage == "after":
                var_east_m2, _, var_north_m2 = fix["covariance_m2"]
                variances.setdefault(truth, []).append((var_east_m2, var_north_m2))
    return errors, variances


def measure_generated_flights(work: Path, title: str, lens: tuple[str, ...]) -> Row:
    """Map and match generated flights of several seeds, with noise on the positions of the map. `lens` are the options
    of the field of view (empty: unknown); with them attitude and height are used, too."""
    errors: dict[str, list[complex]] = {stage: [] for stage in REFINE_FLAGS}
    variances = []
    for seed in SEEDS:
        folder = work / f"seed{seed}{len(lens)}"
        for flight in ("map", "query"):
            write_generated_flight(folder / flight, flight, seed)
        _add_noise(folder / "map" / "positions.csv", seed)
        true = {name: tag.position for name, tag in read_positions(folder / "query" / "positions.csv").items()}
        for stage, flags in REFINE_FLAGS.items():
            path = folder / f"{stage}.gpkg"
            images, queries = folder / "map" / "images", folder / "query" / "images"
            base.run_edgevpr("map", "build", path, "--images", images, *NADIR_FLAGS, *lens, *flags)
            for match in base.run_edgevpr("match", path, "--images", queries, *lens):
                if match["accepted"]:
                    truth, fix = true[match["query"]], match["position"]
                    error_m = offset_m(truth.lat_deg, truth.lon_deg, fix["lat_deg"], fix["lon_deg"])
                    errors[stage].append(complex(*error_m))
                    if stage == "after":
                        variances.append((fix["covariance_m2"][0], fix["covariance_m2"][2]))
    return {
        "set": f"{len(SEEDS)} generated flights, {title}",
        "use": "report",
        "spacing_m": 21.0,
        "errors": {"true": {stage: summarise(values) for stage, values in errors.items()}},
        "within": {"true": compute_sigma_shares(errors["after"], variances, 0.0)},
    }


def _add_noise(path: Path, seed: int) -> None:
    tags, rng = read_positions(path), np.random.default_rng(seed)
    for name, tag in tags.items():
        position = offset_position(tag.position.lat_deg, tag.position.lon_deg, *rng.normal(0, NOISE_SD_M, 2).tolist())
        tags[name] = replace(tag, position=Position(*position, tag.position.alt_m))
    write_positions(path, tags)


def summarise(errors: list[complex]) -> dict:
    """Return count, median and 95th percentile of errors (complex, metres)."""
    errors_m = np.abs(errors)
    return {
        "count": len(errors_m),
        "median_m": round(float(np.median(errors_m)), 2),
        "p95_m": round(float(np.percentile(errors_m, 95)), 2),
    }


def compute_sigma_shares(errors: list[complex], variances: list[tuple[float, float]], more_m2: float) -> dict:
    """Return the shares of errors, axis by axis, within one and two standard deviations of the fix. `variances` are
    (east, north) of each fix; `more_m2`, the variance of the truth, is added."""
    errors_m = np.array([(error.real, error.imag) for error in errors])
    ratio = abs(errors_m) / np.sqrt(np.array(variances) + more_m2)
    return {"one_sigma": round(float((ratio < 1).mean()), 3), "two_sigma": round(float((ratio < 2).mean()), 3)}


def main() -> None:
    result, maps = {**base.describe_run(), "sets": []}, []
    with tempfile.TemporaryDirectory(prefix="edgevpr-where-") as work:
        for folder in base.find_sets(names=SETS):
            row, places, site = measure_set(folder, Path(work))
            result["sets"].append(row)
            maps.append((site, places))
        result["sets"].append(measure_generated_flights(Path(work), "attitude unknown", ()))
        result["sets"].append(measure_generated_flights(Path(work), "attitude known", ("--fov-deg", "66")))
    base.write("where", result, format_page(result))
    draw_maps(maps, RESULTS / "where_maps.png")


def format_page(result: Row) -> str:
    """Return the results as Markdown."""
    rows = [
        {**row, "truth": truth, **stages, "within": row["within"].get(truth)}
        for row in result["sets"]
        for truth, stages in sorted(row["errors"].items())
    ]
    return f"""# Where exactly

{base.strip_title(__doc__, "Writes where.json")}

Errors are median / 95th percentile over accepted matches: before refining, of the position of the place; after it, of
the fix. Within: shares of errors, axis by axis, within one and two standard deviations of the fix (ideal: 0.68, 0.95).
For the truth GPS, these standard deviations include the scatter of the tags as estimated by refining.

{base.format_table(rows, _COLUMNS)}

{base.format_origin(result, "python benchmarks/where.py")} Constants were chosen on the sets marked *tune*.

![maps](where_maps.png)
"""


def draw_maps(maps: list[tuple[AerialSet, dict[str, Place]]], path: Path) -> None:
    """Draw the positions of each map as recorded and as refined, with those of its registered pairs."""
    figure, axes = base.make_panels(14, 14, len(maps), 2)
    for axis, (site, places) in zip(axes, maps, strict=True):
        refined = [name for name, place in places.items() if place.pose]
        places_m = {name: site.to_metres(place.position) for name, place in places.items()}
        registered = [name for name in refined if name in site.truth]
        offset = np.mean([places_m[name] - site.truth[name] for name in registered])
        for name, place_m in places_m.items():
            tag_m = site.tags[name]
            axis.plot([tag_m.real, place_m.real], [tag_m.imag, place_m.imag], color="0.75", lw=0.8, zorder=1)
        for points, mark, colour, label in (
            ([site.tags[name] for name in places], "o", "#c05030", "as recorded"),
            ([places_m[name] for name in refined], "o", "#2060c0", "refined"),
            ([site.truth[name] + offset for name in registered], "+", "black", "registered pairs"),
        ):
            axis.plot(np.real(points), np.imag(points), mark, color=colour, ms=5 if mark == "o" else 9, label=label)
        title = f"{site.name}: {len(refined)} of {len(places)} places refined"
        axis.set(title=title, xlabel="east, m", ylabel="north, m")
        axis.axis("equal")
        axis.legend()
    base.save_figure(figure, path, 60)


if __name__ == "__main__":
    base.run(main)
