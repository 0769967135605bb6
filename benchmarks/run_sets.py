"""Measure every technique, in every form, on every image set of a folder: `make results`.

Writes one JSON file a set into benchmarks/results/ and, from all files that are there, a summary, `sets.md`, the
precision-recall curves, and the table of accuracy that travels with the program. The sets are not part of edgevpr; each
is a folder with query/, ref/, ground_truth.csv and, where GPS is known, positions.csv.
"""

import argparse
import csv
import json
import os
import tempfile
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import base
import sets_page
import yaml
from base import Row

from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import offset_position
from edgevpr.core.text import progress
from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, write_positions
from edgevpr.lab.evaluate import provenance
from edgevpr.lab.evaluate.dataset import Dataset, load_dataset
from edgevpr.lab.evaluate.evaluate import MatchOptions, answer_queries, read_prior, summarise
from edgevpr.lab.evaluate.metrics import add_pcu, read_result
from edgevpr.runtime.preflight.choose import ACCURACY_PATH as ACCURACY
from edgevpr.techniques import create
from edgevpr.techniques.session import hash_model_file

FIVE_PLACES = "five places only: made for studies of change, recall on them says nothing"
JOINED = "aerial_joined"  # all sets from the air as one map: the rows that are measured on it
JOINED_ROWS = ("cohog", "cohog, exact")
# What is not measured, and why.
LEFT_OUT = {"grief_michigan_monthly": FIVE_PLACES, "grief_stromovka_monthly": FIVE_PLACES}
# Rows that no board is offered: other weights, another way to match or to ask, or a comparison with everything.
NOT_OFFERED = ("exact", "thesis", "sequence", "one frame", "original weights", "known", "followed")
# Of a set whose sites have no positions on Earth: where they are said to be, how far apart, and the size of a pixel.
_FIRST_SITE_DEG = (37.0, 36.0)
_SITE_SPACING_M = 20_000.0
_PIXEL_M = 0.5
_COLUMNS = ("query_file", "ref_files", "ref_files_loose")
_MAX_CURVE_POINTS = 25  # that are kept: a curve is only drawn


@dataclass(frozen=True, slots=True)
class Variant:
    """One row of the tables: a technique, how it is set, and how it is asked."""

    label: str
    technique: str
    settings: dict[str, str] = field(default_factory=dict)
    options: MatchOptions = field(default_factory=MatchOptions)


ORIGINAL_CALC = Variant("calc, original weights", "calc", {"model": "calc_original"})
NETWORKS = ("alexnet", "amosnet", "hybridnet", "netvlad", "rmac", "region_vlad", "cross_region_bow")
VECTORS = ("hog", "calc", *NETWORKS)
VARIANTS = (
    Variant("cohog", "cohog"),
    Variant("cohog, known", "cohog", options=MatchOptions(known="heading,height")),
    Variant("cohog, exact", "cohog", options=MatchOptions(exact=True)),
    Variant("cohog, thesis", "cohog", {"matching": "thesis"}, MatchOptions(exact=True)),
    Variant("cohog, followed", "cohog", options=MatchOptions(follow=True)),
    Variant("cohog, sequence 10", "cohog", options=MatchOptions(sequence=10)),
    *(Variant(f"cohog, {n} candidates", "cohog", options=MatchOptions(candidates=n)) for n in (20, 10)),
    Variant("hog", "hog"),
    Variant("seqslam", "seqslam"),
    Variant("seqslam, one frame", "seqslam", options=MatchOptions(sequence=1)),
    Variant("calc", "calc"),
    ORIGINAL_CALC,
    *(Variant(name, name) for name in NETWORKS),
    *(Variant(f"{name} {form}", name, {"form": form}) for name in VECTORS for form in ("8bit", "1bit")),
)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=base.DATA)
    parser.add_argument("--sets", metavar="A,B", help="names of sets, comma-separated (default: all)")
    parser.add_argument("--variants", metavar="A;B", help="rows of the tables, separated by semicolons (default: all)")
    parser.add_argument("--out", type=Path, default=base.RESULTS)
    args = parser.parse_args(argv)
    folders = base.find_sets(args.data, args.sets.split(",") if args.sets else None)
    wanted = find_variants(args.variants.split(";") if args.variants else None)
    args.out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        folders = [
            folder
            if not (folder / "sites.csv").exists()
            else place_sites(folder, Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="edgevpr-placed-"))))
            for folder in folders
        ]
        from_the_air = [folder for folder in folders if base.infer_camera(folder.name) == "nadir"]
        if len(from_the_air) > 1:
            folders.append(Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="edgevpr-joined-"))) / JOINED)
            join_sets(from_the_air, folders[-1])
        weights = base.REPOSITORY.parent / "shared" / "models" / "calc" / "model.onnx"
        if ORIGINAL_CALC in wanted and weights.is_file():
            write_original_calc(
                Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="edgevpr-cards-"))), weights
            )
        else:
            wanted = [variant for variant in wanted if variant is not ORIGINAL_CALC]
        for folder in folders:
            rows = [row for row in wanted if folder.name != JOINED or row.label in JOINED_ROWS]
            if rows and folder.name not in LEFT_OUT:
                write_set(args.out / f"{folder.name}.json", folder, rows)
    if args.out.resolve() == base.RESULTS:  # figures of other sets, or of a trial, do not travel
        write_accuracy(sets_page.read_sets(args.out))
    left_out = {folder.name: LEFT_OUT[folder.name] for folder in folders if folder.name in LEFT_OUT}
    sets_page.write_page(args.out, left_out)


def place_sites(folder: Path, work: Path) -> Path:
    """Make a copy in `work` of a set that says in sites.csv where its pictures lie in those of their sites. It gets a
    positions.csv: within a site positions are true to the pixel, where the sites lie on Earth is invented."""
    out, sites, tags = work / folder.name, [], {}
    out.mkdir()
    for name in ("query", "ref", "ground_truth.csv"):
        (out / name).symlink_to((folder / name).resolve())
    for row in base.read_csv(folder / "sites.csv"):
        if row["site"] not in sites:
            sites.append(row["site"])
        site = offset_position(*_FIRST_SITE_DEG, _SITE_SPACING_M * sites.index(row["site"]), 0.0)
        position = Position(*offset_position(*site, _PIXEL_M * float(row["x_px"]), -_PIXEL_M * float(row["y_px"])))
        tags[row["file"]] = GeoTag(position=position, heading_deg=float(row["yaw_deg"]))
    write_positions(out / "positions.csv", tags)
    return out


def join_sets(folders: list[Path], out: Path) -> None:
    """Make one set of several: every query asks for its place among the places of all."""
    rows = []
    for folder in folders:
        for part in ("query", "ref"):
            (out / part).mkdir(parents=True, exist_ok=True)
            for path in (folder / part).iterdir():
                (out / part / f"{folder.name}_{path.name}").symlink_to(path.resolve())
        for row in base.read_csv(folder / "ground_truth.csv"):
            named = ([f"{folder.name}_{name}" for name in (row.get(key) or "").split()] for key in _COLUMNS)
            rows.append([*map(" ".join, named), row.get("status") or "ok"])
    with open(out / "ground_truth.csv", "w", newline="") as handle:
        csv.writer(handle).writerows([(*_COLUMNS, "status"), *rows])


def find_variants(labels: list[str] | None) -> list[Variant]:
    """Return the variants with these labels (None: all). Raises UsageError for one that is not there."""
    variants = {variant.label: variant for variant in VARIANTS}
    for label in labels or ():
        if label not in variants:
            raise UsageError(f"There is no row `{label}`: use some of {'; '.join(variants)}.")
    return [variant for label, variant in variants.items() if labels is None or label in labels]


def write_original_calc(cards: Path, weights: Path) -> None:
    """Put CALC's published weights and a card for them where edgevpr looks for the models of a user."""
    (cards / "calc_original.onnx").symlink_to(weights.resolve())
    card = yaml.safe_load((base.REPOSITORY / "models" / "calc.yaml").read_text())
    card |= {"title": "CALC, the authors' weights", "file": "calc_original.onnx", "sha256": hash_model_file(weights)}
    card |= {"licence": "see the file's own", "source": "Merrill and Huang 2018, as an ONNX file"}
    card |= {"outputs": {"descriptor": "descriptor", "features": None}}
    (cards / "calc_original.yaml").write_text(yaml.safe_dump(card))
    os.environ["EDGEVPR_MODELS"] = str(cards)


def write_set(path: Path, folder: Path, wanted: list[Variant]) -> None:
    """Measure a set and write its file: rows measured before and not now stay as they are, each with its commit."""
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    rows: Row = sets_page.index_rows(base.read(path.stem, path.parent))
    if not (wanted := [variant for variant in wanted if is_applicable(variant, folder, dataset)]):
        return
    for variant in wanted:

        def show_progress(items, total, label, variant=variant):
            return progress(items, total, f"{folder.name}, {variant.label}, {label.partition(': ')[2]}")

        technique = create(variant.technique, make_settings(variant, folder))
        answers, not_done = answer_queries(technique, dataset, variant.options, show_progress)
        result = summarise(technique, dataset, answers, variant.options, not_done)
        rows[variant.label] = asdict(replace(result, technique=variant.label)) | {
            "precision_recall": base.thin_evenly(result.precision_recall, _MAX_CURVE_POINTS)
            if sets_page.has_curve(variant.label)
            else [],
            "commit": base.read_commit(),
            "cpu": provenance.read_cpu_model(),
        }
    in_order = [rows[variant.label] for variant in VARIANTS if variant.label in rows]
    for row, result in zip(in_order, add_pcu(read_result(row) for row in in_order), strict=True):
        row |= asdict(result)  # the slowest encoder of all may be another now
    run = base.describe_run()
    content = {"set": folder.name, "use": base.find_use(folder.name), "date": run["date"], "machine": run["machine"]}
    content["ah_assumes"] = in_order[0]["ah_assumes"]
    content["rows"] = [{key: value for key, value in row.items() if key != "ah_assumes"} for row in in_order]
    base.write_json(path.stem, content, path.parent)


def is_applicable(variant: Variant, folder: Path, dataset: Dataset) -> bool:
    """Return True if a set says what a variant is told of each query."""
    if not variant.options.known:
        return True
    spec = create(variant.technique, make_settings(variant, folder)).spec
    try:
        read_prior(variant.options.known, dataset, spec, variant.options.sequence)
    except UsageError:
        return False
    return True


def make_settings(variant: Variant, folder: Path) -> dict[str, str]:
    """Return how a variant is used on a set: `cohog` looks down in those from the air; the thesis's has no camera."""
    looks_down = variant.technique == "cohog" and "matching" not in variant.settings
    return variant.settings | ({"camera": "nadir"} if looks_down and base.infer_camera(folder.name) == "nadir" else {})


def write_accuracy(contents: list[Row]) -> None:
    """Write the table of how well each technique recognises, by the way the camera looks, that travels with the
    program: recall is that of the sets that are reported, what was accepted that of all."""
    accuracy: dict[str, Row] = {"forward": {}, "nadir": {}}
    for camera, table in accuracy.items():
        sets = [row for row in contents if base.infer_camera(row["set"]) == camera and row["set"] != JOINED]
        for label in dict.fromkeys(label for content in sets for label in content["techniques"]):
            if not any(word in label for word in NOT_OFFERED):
                rows = [(row["use"], row["techniques"][label]) for row in sets if label in row["techniques"]]
                reported, results = [row for use, row in rows if use == "report"], [row for _, row in rows]
                recalls = [sets_page.select_match_figures(row) for row in reported]
                table[label] = {
                    "recall_at_1": round(sum(row["recall_at_1"] for row in recalls) / len(recalls), 4),
                    "sets": len(recalls),
                    "queries": sum(row["queries"] for row in recalls),
                    "asked": sum(row["queries"] for row in results),
                    **{key: sum(row[key] for row in results) for key in ("accepted", "accepted_wrong")},
                    "accepted_elsewhere": sum(read_result(row).accepted_elsewhere for row in results),
                }
    ACCURACY.write_text(json.dumps(accuracy, indent=1) + "\n")


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
