"""Measure hog and cohog on every image set of a folder: `make results`.

Writes one JSON file a set and a summary, `sets.md`, into benchmarks/results/. The sets are not part of edgevpr; each is
a folder with query/, ref/, ground_truth.csv and, where GPS is known, positions.csv.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edgevpr.errors import EdgevprError, UsageError
from edgevpr.evaluate import tables
from edgevpr.evaluate.dataset import load_dataset
from edgevpr.evaluate.evaluate import TechniqueResult, as_json, compare, evaluate
from edgevpr.runtime.progress import progress

REPOSITORY = Path(__file__).resolve().parents[1]
TECHNIQUES = ("hog", "cohog")
TUNED_ON = ("corridor", "aerial_caliterra")
# Why a technique is not measured on a set.
LEFT_OUT = {
    ("nordland_tiny", "cohog"): "pictures of 64x32 pixels are too small for its regions, and 994 x 994 comparisons in "
    "full take a quarter of an hour",
    **{
        (name, technique): "five places only: made for studies of change, its recall says nothing"
        for name in ("grief_michigan_monthly", "grief_stromovka_monthly")
        for technique in TECHNIQUES
    },
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--data", type=Path, default=os.environ.get("EDGEVPR_DATA") or REPOSITORY.parent / "shared/data"
    )
    parser.add_argument("--sets", metavar="A,B", help="names of sets, comma-separated (default: all)")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "benchmarks" / "results")
    args = parser.parse_args()
    try:
        folders = find_sets(args.data, args.sets.split(",") if args.sets else None)
        args.out.mkdir(parents=True, exist_ok=True)
        made_by = provenance()
        measured = {}
        for folder in folders:
            wanted = [name for name in TECHNIQUES if (folder.name, name) not in LEFT_OUT]
            if wanted:
                measured[folder.name] = results, positions = measure(folder, wanted)
                content = {"set": folder.name, "use": use(folder.name), **made_by, **as_json(results)}
                if positions:
                    content["positions"] = positions
                (args.out / f"{folder.name}.json").write_text(json.dumps(content, indent=2) + "\n")
        (args.out / "sets.md").write_text(summary(measured, [folder.name for folder in folders], made_by))
    except EdgevprError as error:
        print(f"run_sets: {error}", file=sys.stderr)
        return error.exit_code
    print((args.out / "sets.md").read_text())
    return 0


def find_sets(data: Path, names: list[str] | None) -> list[Path]:
    """The folders of `data` that have a ground truth. Raises UsageError where there are none."""
    found = {path.parent.name: path.parent for path in sorted(data.glob("*/ground_truth.csv"))}
    missing = [name for name in names or () if name not in found]
    if missing or not found:
        what = f"no set `{missing[0]}`" if missing else "no image sets (folders with a ground_truth.csv)"
        raise UsageError(f"There are {what} in {data}: name the right folder with --data or EDGEVPR_DATA.")
    return [folder for name, folder in found.items() if names is None or name in names]


def use(name: str) -> str:
    """Whether edgevpr's parameters were chosen on a set ("tune") or it is only reported on ("report")."""
    return "tune" if name in TUNED_ON else "report"


def measure(folder: Path, names: list[str]) -> tuple[list[TechniqueResult], dict[str, Any]]:
    """Recall and costs of each technique and, where GPS is known, its errors in metres."""
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")

    def shown(items, total, label):
        return progress(items, total, f"{folder.name}, {label}")

    results = compare([evaluate(name, dataset, None, shown) for name in names])
    known = (folder / "positions.csv").is_file()
    return results, {name: position_errors(folder, name) for name in names} if known else {}


def position_errors(folder: Path, technique: str) -> dict[str, Any]:
    """Map the references and match all queries, scored or not, by the commands that a user has."""
    with tempfile.TemporaryDirectory(prefix="edgevpr-sets-") as temporary:
        place_map = f"{temporary}/{folder.name}.gpkg"
        edgevpr("map", "build", place_map, "--images", str(folder / "ref"), "--technique", technique, "--json")
        matches = edgevpr("match", place_map, "--images", str(folder / "query"), "--json")
    return {
        "queries": len(matches),
        "best_match": spread([match["error_m"] for match in matches]),
        "accepted": spread([match["error_m"] for match in matches if match["accepted"]]),
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


def provenance() -> dict[str, Any]:
    """Where, when and from what the figures were made."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(REPOSITORY), *arguments], capture_output=True, text=True)
        return done.stdout.strip()

    changed = git("status", "--porcelain", "--", "edgevpr")
    return {
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d"),
        "commit": (git("rev-parse", "--short", "HEAD") or "unknown") + (" with changes" if changed else ""),
        "machine": {
            "cpu": cpu_model(),
            "cores": len(os.sched_getaffinity(0)),
            "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS", "all"),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "opencv": cv2.__version__,
        },
    }


def cpu_model() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith(("model name", "Model")):
            return line.partition(":")[2].strip()
    return platform.machine()


def summary(measured: dict[str, tuple[list[TechniqueResult], dict]], names: list[str], made_by: dict[str, Any]) -> str:
    """The page that says it all: tables of all sets, and what to make of them."""
    machine = made_by["machine"]
    result_rows = [
        [name, use(name), f"{result.queries} / {result.references}", *tables.cells(result)]
        for name, (results, _) in measured.items()
        for result in results
    ]
    position_rows = [
        [name, technique, f"{errors['queries']}", *(metres(errors[kind]) for kind in ("best_match", "accepted"))]
        for name, (_, positions) in measured.items()
        for technique, errors in positions.items()
    ]
    left_out = [f"* {name}, {technique}: {why}." for (name, technique), why in LEFT_OUT.items() if name in names]
    return f"""# hog and cohog on real images

Made by `make results` on {made_by["date"]} from commit {made_by["commit"]}. {machine["cpu"]}, {machine["cores"]} cores,
{machine["blas_threads"]} BLAS thread(s), Python {machine["python"]}, NumPy {machine["numpy"]}, OpenCV {machine["opencv"]}.

Parameters and acceptance rules were chosen on the sets marked *tune* and on no others; *report* sets are for reporting
only. All places are compared in full. The truth of the aerial sets was computed by image registration: it favours pairs
that local features can match. `edgevpr eval` gives the same figures for any set; the JSON files beside this page hold
more of them.

{tables.markdown(("set", "use", "queries / references", *tables.HEADINGS), result_rows)}

* P@100%R: precision with the threshold at the lowest-scoring right match. R@100%P: recall with the threshold above the
  highest-scoring wrong one. AUC, EP: equations 2.3 and 2.4 of the thesis.
* ROC: the chance that a right match scores higher than a wrong one; 0.5 means that the score alone tells nothing.
* PCU: P@100%R x log10(t_e,max / t_e + 9), where t_e,max is the slower encoder of the two on the same set.
* accepted: queries that would have moved the aircraft by the technique's own rule, in brackets how many of them wrongly.
* Times are means; t_m is for all references. mAh: {next(iter(measured.values()))[0][0].ah_assumes}.

## Errors in metres

{tables.markdown(("set", "technique", "queries", "best match of all", "accepted"), position_rows)}

Distance between the GPS position of the query and that of the place, `median / 90 % / worst (how many)`, over all
queries of the folder, those too that show nothing of the map. It cannot be smaller than the distance to the nearest
place, and the GPS of these cameras is noisy (swindale: tens of metres; caliterra: 10 to 20 m).

## Left out

{chr(10).join(left_out)}
"""


def metres(errors: dict[str, Any]) -> str:
    if not errors["count"]:
        return "none"
    return f"{errors['median_m']:.0f} / {errors['p90_m']:.0f} / {errors['worst_m']:.0f} ({errors['count']})"


if __name__ == "__main__":
    sys.exit(main())
