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
from typing import Any

import base
import numpy as np
import sets_page
import yaml

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
_FIRST_SITE, _SITES_APART_M, _PIXEL_M = (37.0, 36.0), 20_000.0, 0.5
_COLUMNS = ("query_file", "ref_files", "ref_files_loose")
_POINTS = 25  # of a curve that is kept


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
            else placed(folder, Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="edgevpr-placed-"))))
            for folder in folders
        ]
        from_the_air = [folder for folder in folders if base.camera_of(folder.name) == "nadir"]
        if len(from_the_air) > 1:
            folders.append(Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="edgevpr-joined-"))) / JOINED)
            join(from_the_air, folders[-1])
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
    sets_page.write(args.out, {folder.name: LEFT_OUT[folder.name] for folder in folders if folder.name in LEFT_OUT})


def placed(folder: Path, work: Path) -> Path:
    """Make a copy in `work` of a set that says in sites.csv where its pictures lie in those of their sites. It gets a
    positions.csv: within a site positions are true to the pixel, where the sites lie on Earth is invented."""
    out, sites, tags = work / folder.name, [], {}
    out.mkdir()
    for name in ("query", "ref", "ground_truth.csv"):
        (out / name).symlink_to((folder / name).resolve())
    for row in base.read_csv(folder / "sites.csv"):
        if row["site"] not in sites:
            sites.append(row["site"])
        site = offset_position(*_FIRST_SITE, _SITES_APART_M * sites.index(row["site"]), 0.0)
        position = Position(*offset_position(*site, _PIXEL_M * float(row["x_px"]), -_PIXEL_M * float(row["y_px"])))
        tags[row["file"]] = GeoTag(position=position, heading_deg=float(row["yaw_deg"]))
    write_positions(out / "positions.csv", tags)
    return out


def join(folders: list[Path], out: Path) -> None:
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
    known = {variant.label: variant for variant in VARIANTS}
    for label in labels or ():
        if label not in known:
            raise UsageError(f"There is no row `{label}`: use some of {'; '.join(known)}.")
    return [variant for label, variant in known.items() if labels is None or label in labels]


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
    rows: dict[str, Any] = sets_page.by_name(base.read(path.stem, path.parent))
    if not (wanted := [variant for variant in wanted if can_be_asked(variant, folder, dataset)]):
        return
    for variant in wanted:

        def shown(items, total, label, variant=variant):
            return progress(items, total, f"{folder.name}, {variant.label}, {label.partition(': ')[2]}")

        technique = create(variant.technique, settings(variant, folder))
        answers, not_done = answer_queries(technique, dataset, variant.options, shown)
        result = summarise(technique, dataset, answers, variant.options, not_done)
        rows[variant.label] = asdict(replace(result, technique=variant.label)) | {
            "precision_recall": thinned(result.precision_recall) if sets_page.is_drawn(variant.label) else [],
            "commit": base.commit(),
            "cpu": provenance.read_cpu_model(),
        }
    in_order = [rows[variant.label] for variant in VARIANTS if variant.label in rows]
    for row, each in zip(in_order, add_pcu(read_result(row) for row in in_order), strict=True):
        row |= asdict(each)  # the slowest encoder of all may be another now
    made = base.made_by()
    content = {"set": folder.name, "use": base.use_of(folder.name), "date": made["date"], "machine": made["machine"]}
    content["ah_assumes"] = in_order[0]["ah_assumes"]
    content["rows"] = [{key: value for key, value in row.items() if key != "ah_assumes"} for row in in_order]
    base.write_json(path.stem, content, path.parent)


def can_be_asked(variant: Variant, folder: Path, dataset: Dataset) -> bool:
    """Return True if a set says what a variant is told of each query."""
    if not variant.options.known:
        return True
    spec = create(variant.technique, settings(variant, folder)).spec
    try:
        read_prior(variant.options.known, dataset, spec, variant.options.sequence)
    except UsageError:
        return False
    return True


def thinned(curve: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return at most some points of a curve, evenly spread: it is only drawn from here on."""
    return [curve[at] for at in np.unique(np.linspace(0, len(curve) - 1, min(len(curve), _POINTS)).round().astype(int))]


def settings(variant: Variant, folder: Path) -> dict[str, str]:
    """Return how a variant is used on a set: `cohog` looks down in those from the air; the thesis's has no camera."""
    looks_down = variant.technique == "cohog" and "matching" not in variant.settings
    return variant.settings | ({"camera": "nadir"} if looks_down and base.camera_of(folder.name) == "nadir" else {})


def write_accuracy(contents: list[dict[str, Any]]) -> None:
    """Write the table of how well each technique recognises, by the way the camera looks, that travels with the
    program: recall is that of the sets that are reported, what was accepted that of all."""
    found: dict[str, dict[str, Any]] = {"forward": {}, "nadir": {}}
    for camera, table in found.items():
        of_camera = [each for each in contents if base.camera_of(each["set"]) == camera and each["set"] != JOINED]
        for label in dict.fromkeys(label for each in of_camera for label in each["techniques"]):
            if not any(word in label for word in NOT_OFFERED):
                rows = [(each["use"], each["techniques"][label]) for each in of_camera if label in each["techniques"]]
                reported, results = [row for use, row in rows if use == "report"], [row for _, row in rows]
                recalls = [sets_page.of_matches(row) for row in reported]
                table[label] = {
                    "recall_at_1": round(sum(row["recall_at_1"] for row in recalls) / len(recalls), 4),
                    "sets": len(recalls),
                    "queries": sum(row["queries"] for row in recalls),
                    "asked": sum(row["queries"] for row in results),
                    **{key: sum(row[key] for row in results) for key in ("accepted", "accepted_wrong")},
                    "accepted_elsewhere": sum(read_result(row).accepted_elsewhere for row in results),
                }
    ACCURACY.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
