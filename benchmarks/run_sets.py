"""Measure every technique, in every form, on every image set of a folder: `make results`.

Writes one JSON file a set into benchmarks/results/ and, from all files that are there, a summary, `sets.md`, and the
precision-recall curves. The sets are not part of edgevpr; each is a folder with query/, ref/, ground_truth.csv and,
where GPS is known, positions.csv.
"""

import argparse
import csv
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import accuracy_table
import cv2
import numpy as np
import sets_page
import yaml

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.progress import progress
from edgevpr.lab.evaluate import provenance
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import compare, evaluate
from edgevpr.techniques.networks.session import file_sha256

REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS = REPOSITORY / "benchmarks" / "results"
DATA = Path(os.environ.get("EDGEVPR_DATA") or REPOSITORY.parent / "shared" / "data")
TUNED_ON = ("corridor", "aerial_caliterra", "aerial_garfield28")
FROM_THE_AIR = ("aerial_", "kite_")  # how the names of such sets begin


@dataclass(frozen=True, slots=True)
class Variant:
    """One row of the tables: a technique, how it is set, how many queries are matched together and how many places are
    compared (None: its own numbers), whether all places are compared in full, and whether the queries are followed as
    those of a flight."""

    label: str
    technique: str
    settings: dict[str, str] = field(default_factory=dict)
    sequence: int | None = None
    candidates: int | None = None
    exact: bool = False
    follow: bool = False


ORIGINAL_CALC = Variant("calc, original weights", "calc", {"model": "calc_original"})
ON_SHIPPED_BACKBONE = tuple(
    Variant(name, name)
    for name in ("alexnet", "amosnet", "hybridnet", "netvlad", "rmac", "region_vlad", "cross_region_bow")
)
VECTORS = ("hog", "calc", *(variant.technique for variant in ON_SHIPPED_BACKBONE))
PACKED = tuple(Variant(f"{name} {form}", name, {"form": form}) for name in VECTORS for form in ("8bit", "1bit"))
VARIANTS = (
    Variant("cohog", "cohog"),
    Variant("cohog, exact", "cohog", exact=True),
    Variant("cohog, thesis", "cohog", {"matching": "thesis"}, exact=True),
    Variant("cohog, followed", "cohog", follow=True),
    Variant("cohog, sequence 10", "cohog", sequence=10),
    *(Variant(f"cohog, {count} candidates", "cohog", candidates=count) for count in (20, 10)),
    Variant("hog", "hog"),
    Variant("seqslam", "seqslam"),
    Variant("seqslam, one frame", "seqslam", sequence=1),
    Variant("calc", "calc"),
    ORIGINAL_CALC,
    *ON_SHIPPED_BACKBONE,
    *PACKED,
)

FIVE_PLACES = "five places only: made for studies of change, recall on them says nothing"
JOINED = "aerial_joined"  # all sets from the air as one map: the rows that are measured on it
JOINED_ROWS = ("cohog", "cohog, exact")
# What is not measured, and why.
LEFT_OUT = {"grief_michigan_monthly": FIVE_PLACES, "grief_stromovka_monthly": FIVE_PLACES}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--sets", metavar="A,B", help="names of sets, comma-separated (default: all)")
    parser.add_argument("--variants", metavar="A;B", help="rows of the tables, separated by semicolons (default: all)")
    models = REPOSITORY.parent / "shared" / "models"
    parser.add_argument(
        "--models", type=Path, default=models, help="a folder with the original weights: calc/model.onnx"
    )
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args(argv)
    try:
        with ExitStack() as stack:
            folders = find_sets(args.data, args.sets.split(",") if args.sets else None)
            from_the_air = [folder for folder in folders if folder.name.startswith(FROM_THE_AIR)]
            if len(from_the_air) > 1:
                joined = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="edgevpr-joined-"))) / JOINED
                join(from_the_air, joined)
                folders.append(joined)
            kept = [folder for folder in folders if folder.name not in LEFT_OUT]
            if not kept:
                raise UsageError(
                    f"All sets of {args.data} are left out: name another folder with --data or EDGEVPR_DATA."
                )
            wanted = find_variants(args.variants.split(";") if args.variants else None)
            cards = stack.enter_context(tempfile.TemporaryDirectory(prefix="edgevpr-cards-"))
            weights = args.models / "calc" / "model.onnx"
            if ORIGINAL_CALC in wanted and weights.is_file():
                write_original_calc(Path(cards), weights)
            else:
                wanted = [variant for variant in wanted if variant is not ORIGINAL_CALC]
            args.out.mkdir(parents=True, exist_ok=True)
            commit = commit_of()
            for folder in kept:
                rows = [row for row in wanted if folder.name != JOINED or row.label in JOINED_ROWS]
                if rows:
                    write_set(args.out / f"{folder.name}.json", folder, rows, commit)
        if args.out.resolve() == RESULTS:  # figures of other sets, or of a trial, do not travel
            write_accuracy(args.out)
        sets_page.write(args.out, {folder.name: LEFT_OUT[folder.name] for folder in folders if folder.name in LEFT_OUT})
    except EdgevprError as error:
        print(f"run_sets: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def write_accuracy(out: Path) -> None:
    """Write the table that travels with the program, of all results that are there."""
    contents = [json.loads(path.read_text()) for path in sorted(out.glob("*.json"))]
    contents = [each for each in contents if "techniques" in each]
    looks_down = {each["set"]: each["set"].startswith(FROM_THE_AIR) for each in contents}
    accuracy_table.write(contents, looks_down, JOINED)


def find_sets(data: Path, names: list[str] | None) -> list[Path]:
    """The folders of `data` that have a ground truth. Raises UsageError where there are none."""
    found = {path.parent.name: path.parent for path in sorted(data.glob("*/ground_truth.csv"))}
    missing = [name for name in names or () if name not in found]
    if missing or not found:
        what = f"no set `{missing[0]}`" if missing else "no image sets (folders with a ground_truth.csv)"
        raise UsageError(f"There are {what} in {data}: name the right folder with --data or EDGEVPR_DATA.")
    return [folder for name, folder in found.items() if names is None or name in names]


def join(folders: list[Path], out: Path) -> None:
    """Make one set of several: every query asks for its place among the places of all."""
    rows = []
    for part in ("query", "ref"):
        (out / part).mkdir(parents=True)
        for folder in folders:
            for path in (folder / part).iterdir():
                (out / part / f"{folder.name}_{path.name}").symlink_to(path.resolve())
    for folder in folders:
        with open(folder / "ground_truth.csv", newline="") as handle:
            for row in csv.DictReader(handle):
                names = {key: row.get(key) or "" for key in ("query_file", "ref_files", "ref_files_loose")}
                named = {key: " ".join(f"{folder.name}_{name}" for name in each.split()) for key, each in names.items()}
                rows.append({**named, "status": row.get("status") or "ok"})
    with open(out / "ground_truth.csv", "w", newline="") as handle:
        table = csv.DictWriter(handle, rows[0])
        table.writeheader()
        table.writerows(rows)


def find_variants(labels: list[str] | None) -> list[Variant]:
    """The variants with these labels (None: all). Raises UsageError for one that is not there."""
    known = {variant.label: variant for variant in VARIANTS}
    for label in labels or ():
        if label not in known:
            raise UsageError(f"There is no row `{label}`: use some of {'; '.join(known)}.")
    return [variant for label, variant in known.items() if labels is None or label in labels]


def write_original_calc(cards: Path, weights: Path) -> None:
    """Put CALC's published weights and a card for them where edgevpr looks for the models of a user."""
    (cards / "calc_original.onnx").symlink_to(weights.resolve())
    card = yaml.safe_load((REPOSITORY / "models" / "calc.yaml").read_text())
    card |= {
        "title": "CALC, the authors' weights",
        "file": "calc_original.onnx",
        "sha256": file_sha256(weights),
        "licence": "see the file's own",
        "source": "Merrill and Huang 2018, as an ONNX file",
        "outputs": {"descriptor": "descriptor", "features": None},
    }
    (cards / "calc_original.yaml").write_text(yaml.safe_dump(card))
    os.environ["EDGEVPR_MODELS"] = str(cards)


def write_set(path: Path, folder: Path, wanted: list[Variant], commit: str) -> None:
    """Measure a set and write its file: rows measured before and not now stay as they are, each with its commit."""
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    before = json.loads(path.read_text()) if path.exists() else {}
    rows: dict[str, Any] = before.get("techniques", {})
    for variant in wanted:

        def shown(items, total, label, variant=variant):
            return progress(items, total, f"{folder.name}, {variant.label}, {label.partition(': ')[2]}")

        chosen = settings(variant, folder)
        count = variant.candidates
        result = evaluate(
            variant.technique,
            dataset,
            chosen,
            count,
            shown,
            variant.sequence,
            exact=variant.exact,
            follow=variant.follow,
        )
        rows[variant.label] = {
            **asdict(replace(result, technique=variant.label)),
            "encode_ram_mb": encode_ram_mb(variant.technique, chosen),
            "commit": commit,
            "cpu": provenance.cpu_model(),
        }
    in_order = [rows[variant.label] for variant in VARIANTS if variant.label in rows]
    for row, each in zip(in_order, compare(sets_page.result(row) for row in in_order), strict=True):
        row |= asdict(each)  # the slowest encoder of all may be another now
    content = {
        "set": folder.name,
        "use": "tune" if folder.name in TUNED_ON else "report",
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d"),
        "machine": machine(),
        "techniques": {row["technique"]: row for row in in_order},
    }
    if (folder / "positions.csv").is_file():
        flown = [name for name in ("hog", "cohog") if any(variant.label == name for variant in wanted)]
        content["positions"] = before.get("positions", {}) | {name: position_errors(folder, name) for name in flown}
    path.write_text(json.dumps(content, indent=1) + "\n")


def settings(variant: Variant, folder: Path) -> dict[str, str]:
    """How a variant is used on a set: `cohog` looks down in those from the air; the thesis's has no camera."""
    looks_down = variant.technique == "cohog" and "matching" not in variant.settings
    from_the_air = folder.name.startswith(FROM_THE_AIR)
    return {**variant.settings, **({"camera": "nadir"} if looks_down and from_the_air else {})}


def encode_ram_mb(technique: str, chosen: dict[str, str]) -> float:
    """What a technique adds to the resident memory of a process that has NumPy and OpenCV, until it has encoded one
    picture of 640x480: its libraries, its weights, and the work itself at its highest. Each in a process of its own."""
    script = Path(__file__).with_name("encode_ram.py")
    done = subprocess.run(
        [sys.executable, str(script), technique, json.dumps(chosen)], stdout=subprocess.PIPE, text=True, check=True
    )
    return float(done.stdout)


def position_errors(folder: Path, technique: str) -> dict[str, Any]:
    """Map the references and match all queries, scored or not, by the commands that a user has."""
    with tempfile.TemporaryDirectory(prefix="edgevpr-sets-") as temporary:
        place_map = f"{temporary}/{folder.name}.gpkg"
        flags = [f"--param={key}={value}" for key, value in settings(Variant(technique, technique), folder).items()]
        edgevpr("map", "build", place_map, "--images", str(folder / "ref"), "--technique", technique, *flags, "--json")
        matches = edgevpr("match", place_map, "--images", str(folder / "query"), "--json")
    placed = [match for match in matches if "error_m" in match]
    return {
        "queries": len(placed),
        "best_match": spread([match["error_m"] for match in placed]),
        "accepted": spread([match["error_m"] for match in placed if match["accepted"]]),
    }


def edgevpr(*arguments: str) -> Any:
    """What a command of edgevpr prints as JSON. Raises EdgevprError where it fails, having said why."""
    done = subprocess.run([sys.executable, "-m", "edgevpr", *arguments], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise EdgevprError(f"`edgevpr {' '.join(arguments)}` failed (see above): correct what it names.")
    return json.loads(done.stdout)


def spread(errors_m: list[float]) -> dict[str, float | int | None]:
    """How many errors, their median, the one that 90 % stay below, and the worst."""
    if not errors_m:
        return {"count": 0, "median_m": None, "p90_m": None, "worst_m": None}
    median_m, p90_m, worst_m = (round(float(np.percentile(errors_m, share)), 1) for share in (50, 90, 100))
    return {"count": len(errors_m), "median_m": median_m, "p90_m": p90_m, "worst_m": worst_m}


def parser_of(doc: str, work: str) -> argparse.ArgumentParser:
    """Return the parser of a measurement that keeps what is done in the folder `work`."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--work", type=Path, default=Path(work), help="folder of what is done")
    parser.add_argument("--out", type=Path, default=RESULTS)
    return parser


def write_rows(
    out: Path, name: str, rows: list[dict], page: Callable[[dict], str], draw: Callable[[Path, list[dict]], None]
) -> None:
    """Write what has been measured so far as NAME.json, and its page and picture as NAME.md and NAME.png."""
    out.mkdir(parents=True, exist_ok=True)
    content = {**made_by(), "tuned_on": list(TUNED_ON), "rows": rows}
    (out / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")
    (out / f"{name}.md").write_text(page(content))
    draw(out / f"{name}.png", rows)


def made_by() -> dict[str, Any]:
    """Return the date, the commit and the machine of a measurement."""
    return {"date": datetime.now(timezone.utc).strftime("%Y-%m-%d"), "commit": commit_of(), "machine": machine()}


def commit_of() -> str:
    """The commit that is measured, and whether something has changed since."""
    return provenance.commit_of(REPOSITORY) or "unknown"


def machine() -> dict[str, Any]:
    """Where the figures are made."""
    return {
        **provenance.machine(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
    }


if __name__ == "__main__":
    sys.exit(main())
