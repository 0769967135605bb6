"""Where exactly: how far fixes are from the truth, before and after the map is refined (part of `make results`).

The sets from the air with positions, each mapped and matched by the commands that a user has. Truths:

* *pairs*: every registered pair of pictures (pairs_overlap.csv: local features and homographies, made with the sets)
  and all GPS tags in one pose graph, in metres. A fix is compared with it as it lies to the four nearest pictures of
  the map, so that what both have from the same tags does not count.
* *GPS*: the tag of the query, which is itself some metres off.
* *true*: of generated flights, whose cameras are where they say, with 5 m of noise on the positions of the map (in one
  axis). Only this truth is that of the aircraft, and not of the middle of its picture.

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
_PAIR_SD = (0.01, 0.05)  # of a registered pair: of the step, as a share of the longest side, and of the log
_NEAREST = 4
NADIR = ("--technique", "cohog", "--camera", "nadir")
HOWS = {"before": ("--no-refine",), "after": ()}
SEEDS, NOISE_M = (11, 12, 13), 5.0
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
class Set:
    """A set in metres, complex (east + i north) from its first tag: `tags` and, of those in its registered pairs,
    `truth` by name."""

    name: str
    folder: Path
    origin: tuple[float, float]
    tags: dict[str, complex]
    truth: dict[str, complex]

    def to_metres(self, lat_deg: float, lon_deg: float) -> complex:
        """Return a position in metres."""
        return complex(*offset_m(*self.origin, lat_deg, lon_deg))


def load(folder: Path) -> Set:
    """Read a set, and solve its truth."""
    found = {name: tag.position for name, tag in read_positions(folder / "positions.csv").items() if tag.position}
    first = next(iter(found.values()))
    empty = Set(folder.name, folder, (first.lat_deg, first.lon_deg), {}, {})
    tags = {name: empty.to_metres(each.lat_deg, each.lon_deg) for name, each in found.items()}
    names = sorted(tags)
    solved = _registered(folder, names, tags)
    largest = np.bincount(solved.component).argmax()
    truth = {name: complex(solved.position[at]) for at, name in enumerate(names) if solved.component[at] == largest}
    return Set(folder.name, folder, empty.origin, tags, truth)


def _registered(folder: Path, names: list[str], tags: dict[str, complex]) -> GraphSolution:
    number = {name: at for at, name in enumerate(names)}
    rejected_path = folder / "rejected_pairs.csv"
    refused = base.read_csv(rejected_path) if rejected_path.is_file() else []
    rejected, pairs = {(row["file_a"], row["file_b"]) for row in refused}, base.read_csv(folder / "pairs_overlap.csv")
    rows = [row for row in pairs if (row["file_a"], row["file_b"]) not in rejected]
    longest = {name: max(picture(folder, name).shape[:2]) for name in names}
    step = [complex(float(row["dx_px"]), -float(row["dy_px"])) / longest[row["file_b"]] for row in rows]
    turn = [complex(np.log(float(row["scale"])), -np.radians(float(row["rotation_deg"]))) for row in rows]
    step_sd, turn_sd = (np.full(len(rows), each) for each in _PAIR_SD)
    query, place = (np.array([number[row[key]] for row in rows]) for key in ("file_a", "file_b"))
    ties = Ties(query=query, place=place, step=np.array(step), turn=np.array(turn), step_sd=step_sd, turn_sd=turn_sd)
    return solve_graph(np.array([tags[name] for name in names]), ties)


def picture(folder: Path, name: str) -> np.ndarray:
    """Read a picture of a set, of the map or a query."""
    return read_image(next(folder / part / name for part in ("ref", "query") if (folder / part / name).is_file()))


def measure(folder: Path, work: Path) -> tuple[Row, dict[str, Place], Set]:
    """Map and match a set, as it is and refined."""
    of, matches = load(folder), {}
    for how, flags in HOWS.items():
        path = work / f"{folder.name}_{how}.gpkg"
        built = base.edgevpr("map", "build", path, "--images", folder / "ref", *NADIR, *flags)
        matches[how] = base.edgevpr("match", path, "--images", folder / "query")
    with PlaceMap.open(path) as place_map:
        places = {place.source_image: place for place in place_map.read_places()}
    errors, variances = _errors(of, matches, places)
    tag_var = (built["refined"]["recorded_sd_m"] or 0.0) ** 2
    row = {
        "set": folder.name,
        "use": base.use_of(folder.name),
        "spacing_m": float(np.median(abs(np.diff([of.tags[name] for name in places])))),
        "errors": {truth: {how: spread(values) for how, values in by.items()} for truth, by in errors.items()},
        "within": {
            truth: honest(errors[truth]["after"], each, tag_var if truth == "GPS" else 0.0)
            for truth, each in variances.items()
        },
    }
    return row, places, of


def _errors(of: Set, matches: dict[str, list[Row]], places: dict[str, Place]) -> tuple[dict, dict]:
    """Return the errors of fixes by their truth, before and after refining, and the variances of those after it, east
    and north."""
    here = {name: of.to_metres(place.position.lat_deg, place.position.lon_deg) for name, place in places.items()}
    lie = [name for name, place in places.items() if place.pose]
    errors: dict[str, dict[str, list[complex]]] = {}
    variances: dict[str, list[tuple[float, float]]] = {}
    for how, each in ((how, each) for how, found in matches.items() for each in found):
        name, fix = each["query"], each["position"]
        if fix is None or (how == "after" and places[each["place"]["image"]].pose is None):
            continue
        truths = {"GPS": of.tags.get(name)}
        near = sorted(
            (ref for ref in lie if ref in of.truth), key=lambda ref: abs(of.truth[ref] - of.truth.get(name, 0))
        )
        if name in of.truth and len(near) >= _NEAREST:
            truths["pairs"] = of.truth[name] + np.mean([here[ref] - of.truth[ref] for ref in near[:_NEAREST]])
        for truth, at in truths.items():
            here_m = of.to_metres(fix["lat_deg"], fix["lon_deg"])
            errors.setdefault(truth, {}).setdefault(how, []).append(here_m - at)
            if how == "after":
                var_east_m2, _, var_north_m2 = fix["covariance_m2"]
                variances.setdefault(truth, []).append((var_east_m2, var_north_m2))
    return errors, variances


def generated(work: Path, what: str, lens: tuple[str, ...]) -> Row:
    """Map and match generated flights of several seeds, with noise on the positions of the map; with a `lens`, attitude
    and height are used."""
    errors: dict[str, list[complex]] = {how: [] for how in HOWS}
    variances = []
    for seed in SEEDS:
        folder = work / f"seed{seed}{len(lens)}"
        for which in ("map", "query"):
            write_generated_flight(folder / which, which, seed)
        _add_noise(folder / "map" / "positions.csv", seed)
        true = {name: tag.position for name, tag in read_positions(folder / "query" / "positions.csv").items()}
        for how, flags in HOWS.items():
            path, (images, asked) = folder / f"{how}.gpkg", (folder / which / "images" for which in ("map", "query"))
            base.edgevpr("map", "build", path, "--images", images, *NADIR, *lens, *flags)
            for match in base.edgevpr("match", path, "--images", asked, *lens):
                if match["accepted"]:
                    here, where = true[match["query"]], match["position"]
                    off_m = offset_m(here.lat_deg, here.lon_deg, where["lat_deg"], where["lon_deg"])
                    errors[how].append(complex(*off_m))
                    if how == "after":
                        variances.append((where["covariance_m2"][0], where["covariance_m2"][2]))
    return {
        "set": f"{len(SEEDS)} generated flights, {what}",
        "use": "report",
        "spacing_m": 21.0,
        "errors": {"true": {how: spread(values) for how, values in errors.items()}},
        "within": {"true": honest(errors["after"], variances, 0.0)},
    }


def _add_noise(path: Path, seed: int) -> None:
    tags, rng = read_positions(path), np.random.default_rng(seed)
    for name, tag in tags.items():
        at = offset_position(tag.position.lat_deg, tag.position.lon_deg, *rng.normal(0, NOISE_M, 2).tolist())
        tags[name] = replace(tag, position=Position(*at, tag.position.alt_m))
    write_positions(path, tags)


def spread(errors: list[complex]) -> dict:
    """Return count, median and 95th percentile of errors."""
    away = np.abs(errors)
    return {
        "count": len(away),
        "median_m": round(float(np.median(away)), 2),
        "p95_m": round(float(np.percentile(away, 95)), 2),
    }


def honest(errors: list[complex], variances: list[tuple[float, float]], more_m2: float) -> dict:
    """Return which shares of errors, axis by axis, are within one and two standard deviations; `more_m2` is the
    variance of the truth."""
    off = np.array([(each.real, each.imag) for each in errors])
    ratio = abs(off) / np.sqrt(np.array(variances) + more_m2)
    return {"one_sigma": round(float((ratio < 1).mean()), 3), "two_sigma": round(float((ratio < 2).mean()), 3)}


def main() -> None:
    found, shown = {**base.made_by(), "sets": []}, []
    with tempfile.TemporaryDirectory(prefix="edgevpr-where-") as work:
        for folder in base.find_sets(names=SETS):
            row, places, of = measure(folder, Path(work))
            found["sets"].append(row)
            shown.append((of, places))
        found["sets"].append(generated(Path(work), "attitude unknown", ()))
        found["sets"].append(generated(Path(work), "attitude known", ("--fov-deg", "66")))
    base.write("where", found, page(found))
    draw(shown, RESULTS / "where_maps.png")


def page(found: Row) -> str:
    """Return the results as Markdown."""
    rows = [
        {**row, "truth": truth, **by, "within": row["within"].get(truth)}
        for row in found["sets"]
        for truth, by in sorted(row["errors"].items())
    ]
    return f"""# Where exactly

{base.told(__doc__, "Writes where.json")}

Errors are median / 95th percentile of accepted matches: before refining, of the place's own position; after it, of the
fix. Within: shares of errors, axis by axis, within one and two standard deviations of the fix (asked 0.68, 0.95);
against GPS with the scatter of the tags, which refining has estimated, added.

{base.table(rows, _COLUMNS)}

{base.made_line(found, "python benchmarks/where.py")} Constants were chosen on the sets marked *tune*.

![maps](where_maps.png)
"""


def draw(shown: list[tuple[Set, dict[str, Place]]], path: Path) -> None:
    """Draw each map as it was recorded and refined, with the truth of its pairs."""
    drawn, axes = base.panels(14, 14, len(shown), 2)
    for axis, (of, places) in zip(axes, shown, strict=True):
        lie = [name for name, place in places.items() if place.pose]
        here = {name: of.to_metres(each.position.lat_deg, each.position.lon_deg) for name, each in places.items()}
        both = [name for name in lie if name in of.truth]
        offset = np.mean([here[name] - of.truth[name] for name in both])
        for name, at in here.items():
            was = of.tags[name]
            axis.plot([was.real, at.real], [was.imag, at.imag], color="0.75", lw=0.8, zorder=1)
        for points, mark, colour, label in (
            ([of.tags[name] for name in places], "o", "#c05030", "as recorded"),
            ([here[name] for name in lie], "o", "#2060c0", "refined"),
            ([of.truth[name] + offset for name in both], "+", "black", "registered pairs"),
        ):
            axis.plot(np.real(points), np.imag(points), mark, color=colour, ms=5 if mark == "o" else 9, label=label)
        axis.set(title=f"{of.name}: {len(lie)} of {len(places)} places refined", xlabel="east, m", ylabel="north, m")
        axis.axis("equal")
        axis.legend()
    base.save(drawn, path, 60)


if __name__ == "__main__":
    base.run(main)
