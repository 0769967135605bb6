"""Measure hog, and cohog in three forms, on every image set of a folder: `make results`.

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
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edgevpr import techniques
from edgevpr.errors import EdgevprError, UsageError
from edgevpr.evaluate import tables
from edgevpr.evaluate.dataset import load_dataset
from edgevpr.evaluate.evaluate import TechniqueResult, as_json, compare, evaluate
from edgevpr.runtime.progress import progress

REPOSITORY = Path(__file__).resolve().parents[1]
TECHNIQUES = ("hog", "cohog", "cohog_exact", "cohog_thesis")
TUNED_ON = ("corridor", "aerial_caliterra")
FIVE_PLACES = "five places only: made for studies of change, recall on them says nothing"
# What is not measured on a set, and why.
LEFT_OUT = {
    "grief_michigan_monthly": (TECHNIQUES, FIVE_PLACES),
    "grief_stromovka_monthly": (TECHNIQUES, FIVE_PLACES),
    "nordland_tiny": (
        ("cohog", "cohog_exact", "cohog_thesis"),
        "64x32 pixels are too few for its regions",
    ),
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
            left_out, _ = LEFT_OUT.get(folder.name, ((), ""))
            wanted = [name for name in TECHNIQUES if name not in left_out]
            if wanted:
                measured[folder.name] = results, positions = measure(folder, wanted)
                content = {"set": folder.name, "use": use(folder.name), **made_by, **as_json(results)}
                if positions:
                    content["positions"] = positions
                (args.out / f"{folder.name}.json").write_text(json.dumps(content, indent=2) + "\n")
        if not measured:
            raise UsageError(f"All sets of {args.data} are left out: name another folder with --data or EDGEVPR_DATA.")
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

    results = []
    for name in names:
        technique, _, form = name.partition("_")
        chosen = settings(name, folder)
        candidates = None if form else techniques.create(technique, chosen).candidates
        results.append(replace(evaluate(technique, dataset, chosen, candidates, shown), technique=name))
    known = (folder / "positions.csv").is_file()
    flown = [name for name in names if name in techniques.names()]
    return compare(results), {name: position_errors(folder, name) for name in flown} if known else {}


def settings(name: str, folder: Path) -> dict[str, str]:
    """How a technique is used on a set: its camera looks down in the aerial ones; `cohog_thesis` scores as published,
    on the whole picture as it is."""
    if name == "cohog_thesis":
        return {"matching": "thesis"}
    return {"camera": "nadir"} if name != "hog" and folder.name.startswith("aerial_") else {}


def position_errors(folder: Path, technique: str) -> dict[str, Any]:
    """Map the references and match all queries, scored or not, by the commands that a user has."""
    with tempfile.TemporaryDirectory(prefix="edgevpr-sets-") as temporary:
        place_map = f"{temporary}/{folder.name}.gpkg"
        flags = [f"--param={key}={value}" for key, value in settings(technique, folder).items()]
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
    """The page for people: tables of all sets, and what to make of them."""
    machine = made_by["machine"]
    reached = [
        [name, use(name), f"{result.queries} / {result.references}", result.technique, *tables.quality(result)]
        for name, (results, _) in measured.items()
        for result in results
    ]
    paid = [
        [name, result.technique, *tables.costs(result)] for name, (results, _) in measured.items() for result in results
    ]
    away = [
        [name, technique, str(errors["queries"]), metres(errors["best_match"]), metres(errors["accepted"])]
        for name, (_, positions) in measured.items()
        for technique, errors in positions.items()
    ]
    left_out = [f"* {name}: {', '.join(LEFT_OUT[name][0])}: {LEFT_OUT[name][1]}." for name in names if name in LEFT_OUT]
    page = f"""# hog and cohog on real images

Made by `make results` on {made_by["date"]}, commit {made_by["commit"]}.
Machine: {machine["cpu"]}, {machine["cores"]} cores, BLAS threads: {machine["blas_threads"]}.
Python {machine["python"]}, NumPy {machine["numpy"]}, OpenCV {machine["opencv"]}.

`cohog` is as it flies: a scan of 64 bytes a place, then the displacement vote over the best places; in the aerial
sets its camera looks straight down (`--camera nadir`: the picture laid into a square, 24 rotations of the query).
`cohog_exact` votes over all places, under all rotations. `cohog_thesis` scores as published, on the whole picture.
Entropy, vote windows and the acceptance limits of the vote were chosen on the sets marked *tune*. Three figures were
fixed after all sets had been seen, and are to be judged with that in mind: the share of a picture's own mean that its
place code leaves out (0.5), the number of places compared in full (40 ahead, 50 straight down), and the margin of
`cohog_thesis` (0.02, with pictures of foreign sites). The truth of the aerial sets was computed by image registration:
it favours pairs that local features can match, and says nothing of others. The JSON files beside this page hold every
figure.

## Recognition

{tables.markdown(("set", "use", "queries / references", "technique", *tables.QUALITY), reached)}

* P@100%R: precision with the threshold at the lowest-scoring right match. R@100%P: recall with the threshold above the
  highest-scoring wrong one. AUC, EP: equations 2.3 and 2.4 of the thesis.
* ROC: the chance that a right match scores higher than a wrong one; 0.5 means that the score by itself tells nothing.
* PCU: P@100%R x log10(t_e,max / t_e + 9), where t_e,max is the slowest encoder on the same set.
* accepted: queries that would have moved the aircraft by the technique's own rule; in brackets, how many of them would
  have moved it to a wrong place.

## Costs

{tables.markdown(("set", "technique", *tables.COSTS), paid)}

* Means over the queries; t_m is for all references. U: share of all cores.
* mAh: {next(iter(measured.values()))[0][0].ah_assumes}.
"""
    if away:
        page += f"""
## Errors in metres

{tables.markdown(("set", "technique", "queries", "best match", "accepted"), away)}

Distance between the GPS positions of the query and of the place it was matched to: median / 90 % / worst (how many).
All queries with a position are in it, those too that show nothing of the map. The error cannot be smaller than the
distance to the nearest place, and GPS on these cameras is noisy: 10 to 20 m off (caliterra), tens of metres (swindale).
"""
    if left_out:
        page += "\n## Left out\n\n" + "\n".join(left_out) + "\n"
    return page


def metres(errors: dict[str, Any]) -> str:
    if not errors["count"]:
        return "none"
    return f"{errors['median_m']:.0f} / {errors['p90_m']:.0f} / {errors['worst_m']:.0f} ({errors['count']})"


if __name__ == "__main__":
    sys.exit(main())
