"""Measure every technique, in every form, on every image set of a folder: `make results`.

Writes one JSON file per set to benchmarks/results/ and, from all JSON files in that folder, the summary `sets.md`, the
precision-recall curves, and the accuracy table that ships with edgevpr. The image sets are not part of edgevpr; each is
a folder with query/, ref/, ground_truth.csv and, where GPS is known, positions.csv.
"""

import argparse
import csv
import json
import os
import tempfile
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
from edgevpr.lab.evaluate.metrics import add_pcu
from edgevpr.runtime.preflight.choose import ACCURACY_PATH as ACCURACY
from edgevpr.techniques import create
from edgevpr.techniques.session import hash_model_file

FIVE_PLACES = "only five places: made to study changes; recall on five places tells nothing"
JOINED = "aerial_joined"  # one map of all aerial sets; JOINED_ROWS are measured on it
JOINED_ROWS = ("cohog", "cohog, exact")
# Sets that are not measured, and why.
LEFT_OUT = {"grief_michigan_monthly": FIVE_PLACES, "grief_stromovka_monthly": FIVE_PLACES}
# Rows not recommended to any board: other weights, other ways to match or query, or a comparison with all places.
NOT_OFFERED = ("exact", "thesis", "sequence", "one frame", "original weights", "known", "followed")
# For sets whose sites have no known positions: an invented first position, the spacing of sites, the size of a pixel.
_FIRST_SITE_DEG = (37.0, 36.0)
_SITE_SPACING_M = 20_000.0
_PIXEL_M = 0.5
_COLUMNS = ("query_file", "ref_files", "ref_files_loose")
_MAX_CURVE_POINTS = 25  # in the JSON file; enough to draw a curve


@dataclass(frozen=True, slots=True)
class Variant:
    """One row of the tables: a technique, its settings, and the options of its queries."""

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
    parser.add_argument("--data", type=Path, default=base.DATA, help="folder of the image sets")
    parser.add_argument("--sets", metavar="A,B", help="measure these sets, separated by commas (default: all)")
    parser.add_argument("--variants", metavar="A;B", help="measure these rows, separated by semicolons (default: all)")
    parser.add_argument("--out", type=Path, default=base.RESULTS, help="folder of the result files")
    args = parser.parse_args(argv)
    folders = base.find_sets(args.data, args.sets.split(",") if args.sets else None)
    variants = find_variants(args.variants.split(";") if args.variants else None)
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="edgevpr-sets-") as work:
        folders = [place_sites(folder, Path(work)) for folder in folders]
        aerial_folders = [folder for folder in folders if base.infer_camera(folder.name) == "nadir"]
        if len(aerial_folders) > 1:
            folders.append(Path(work) / JOINED)
            join_sets(aerial_folders, folders[-1])
        weights = base.REPOSITORY.parent / "shared" / "models" / "calc" / "model.onnx"
        if ORIGINAL_CALC in variants and weights.is_file():
            write_original_calc(Path(work), weights)
        else:
            variants = [variant for variant in variants if variant is not ORIGINAL_CALC]
        for folder in folders:
            rows = [row for row in variants if folder.name != JOINED or row.label in JOINED_ROWS]
            if rows and folder.name not in LEFT_OUT:
                write_set(args.out / f"{folder.name}.json", folder, rows)
    if args.out.resolve() == base.RESULTS:  # figures of other sets or of trials do not ship
        write_accuracy(sets_page.read_sets(args.out))
    left_out = {folder.name: LEFT_OUT[folder.name] for folder in folders if folder.name in LEFT_OUT}
    sets_page.write_page(args.out, left_out)


def place_sites(folder: Path, work: Path) -> Path:
    """Return the folder of a set: `folder` itself or, if that has a sites.csv (with the pixel of each picture in the
    picture of its site), a copy in `work` with a positions.csv. Offsets within a site are exact to the pixel; the
    positions of the sites are invented."""
    if not (folder / "sites.csv").exists():
        return folder
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
    """Join several sets into one, in which every query is matched against the places of all sets."""
    rows = []
    for folder in folders:
        for part in ("query", "ref"):
            (out / part).mkdir(parents=True, exist_ok=True)
            for path in (folder / part).iterdir():
                (out / part / f"{folder.name}_{path.name}").symlink_to(path.resolve())
        for row in base.read_csv(folder / "ground_truth.csv"):
            cells = ([f"{folder.name}_{name}" for name in (row.get(key) or "").split()] for key in _COLUMNS)
            rows.append([*map(" ".join, cells), row.get("status") or "ok"])
    with open(out / "ground_truth.csv", "w", newline="") as handle:
        csv.writer(handle).writerows([(*_COLUMNS, "status"), *rows])


def find_variants(labels: list[str] | None) -> list[Variant]:
    """Return the variants with these labels (None: all). Raises UsageError for an unknown label."""
    variants = {variant.label: variant for variant in VARIANTS}
    for label in labels or ():
        if label not in variants:
            raise UsageError(f"There is no row `{label}`. The rows are: {'; '.join(variants)}.")
    return [variant for label, variant in variants.items() if labels is None or label in labels]


def write_original_calc(cards: Path, weights: Path) -> None:
    """Install CALC's published weights, with a model card, in `cards`, and let edgevpr read its models there."""
    (cards / "calc_original.onnx").symlink_to(weights.resolve())
    card = yaml.safe_load((base.REPOSITORY / "models" / "calc.yaml").read_text())
    card |= {"title": "CALC, the authors' weights", "file": "calc_original.onnx", "sha256": hash_model_file(weights)}
    card |= {"licence": "see the file's own", "source": "Merrill and Huang 2018, as an ONNX file"}
    card |= {"outputs": {"descriptor": "descriptor", "features": None}}
    (cards / "calc_original.yaml").write_text(yaml.safe_dump(card))
    os.environ["EDGEVPR_MODELS"] = str(cards)


def write_set(path: Path, folder: Path, variants: list[Variant]) -> None:
    """Measure a set and write its JSON file. Rows that are not measured now stay as they are, each with its commit."""
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    rows: Row = sets_page.index_rows(base.read(path.stem, path.parent))
    if not (variants := [variant for variant in variants if is_applicable(variant, folder, dataset)]):
        return
    for variant in variants:

        def show_progress(items, total, label, variant=variant):
            return progress(items, total, f"{folder.name}, {variant.label}, {label.partition(': ')[2]}")

        technique = create(variant.technique, make_settings(variant, folder))
        answers, skipped = answer_queries(technique, dataset, variant.options, show_progress)
        result = summarise(technique, dataset, answers, variant.options, skipped)
        rows[variant.label] = asdict(replace(result, technique=variant.label)) | {
            "precision_recall": base.thin_evenly(result.precision_recall, _MAX_CURVE_POINTS)
            if sets_page.has_curve(variant.label)
            else [],
            "commit": base.read_commit(),
            "cpu": provenance.read_cpu_model(),
        }
    ordered_rows = [rows[variant.label] for variant in VARIANTS if variant.label in rows]
    for row, result in zip(ordered_rows, add_pcu(map(sets_page.read_result, ordered_rows)), strict=True):
        row |= asdict(result)  # PCU depends on the slowest encoder, which may have changed
    run = base.describe_run()
    content = {"set": folder.name, "use": base.find_use(folder.name), "date": run["date"], "machine": run["machine"]}
    content["ah_assumes"] = ordered_rows[0]["ah_assumes"]
    content["rows"] = [{key: value for key, value in row.items() if key != "ah_assumes"} for row in ordered_rows]
    base.write_json(path.stem, content, path.parent)


def is_applicable(variant: Variant, folder: Path, dataset: Dataset) -> bool:
    """Return True if a set has the prior of each query (such as its heading) that a variant needs."""
    if not variant.options.known:
        return True
    spec = create(variant.technique, make_settings(variant, folder)).spec
    try:
        read_prior(variant.options.known, dataset, spec, variant.options.sequence)
    except UsageError:
        return False
    return True


def make_settings(variant: Variant, folder: Path) -> dict[str, str]:
    """Return the settings of a variant for a set: in aerial sets, `cohog` (not the thesis's) has a nadir camera."""
    looks_down = variant.technique == "cohog" and "matching" not in variant.settings
    return variant.settings | ({"camera": "nadir"} if looks_down and base.infer_camera(folder.name) == "nadir" else {})


def write_accuracy(contents: list[Row]) -> None:
    """Write the table that ships with edgevpr: the accuracy of each technique, by the direction of the camera. Recall
    is of the sets marked `report`; counts of accepted matches are of all sets."""
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
                    "accepted_elsewhere": sum(sets_page.read_result(row).accepted_elsewhere for row in results),
                }
    ACCURACY.write_text(json.dumps(accuracy, indent=1) + "\n")


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
