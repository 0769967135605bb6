"""How long `edgevpr eval --out` takes for 600 queries on 600 references, the first time and with all that it has kept:
`python benchmarks/many_sets.py`. The pictures are generated from a seed."""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from run_sets import RESULTS, made_by

from edgevpr.core.text import progress

_HIGH, _WIDE = 360, 480


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pictures", type=int, default=600, help="of queries, and as many references")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--write", action="store_true", help="write benchmarks/results/many_sets.json and .md")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="edgevpr-many-") as temporary:
        folder = Path(temporary)
        make_set(folder / "generated", args.pictures)
        runs = {name: run(folder, args.workers) for name in ("first", "again")}
        (found,) = json.loads((folder / "out" / "results.json").read_text())["results"]
        cache_mb = sum(path.stat().st_size for path in (folder / "out" / "cache").rglob("*") if path.is_file()) / 1e6
    measured = {
        **made_by(),
        "pictures": args.pictures,
        "workers": args.workers,
        "load": os.getloadavg()[1],
        "runs": runs,
        "cache_mb": round(cache_mb, 1),
        "recall_at_1": found["recall_at_1"],
    }
    text = page(measured)
    print(text)
    if args.write:
        (RESULTS / "many_sets.json").write_text(json.dumps(measured, indent=1) + "\n")
        (RESULTS / "many_sets.md").write_text(text)


def make_set(folder: Path, pictures: int) -> None:
    """Make places of generated texture; a query is its place, moved aside, darker and with noise."""
    truth = ["query_file,ref_files"]
    for part in ("query", "ref"):
        (folder / part).mkdir(parents=True)
    for number in progress(range(pictures), pictures, "pictures"):
        rng = np.random.default_rng(number)
        place = np.zeros((_HIGH, _WIDE), np.float32)
        for octave in range(2, 6):
            small = rng.random((2**octave, 2**octave), dtype=np.float32)
            place += cv2.resize(small, (_WIDE, _HIGH), interpolation=cv2.INTER_CUBIC) / octave
        place = cv2.normalize(place, None, 0, 255, cv2.NORM_MINMAX)
        query = 0.8 * np.roll(place, int(rng.integers(0, 30)), 1) + rng.normal(10, 12, place.shape)
        for part, picture in (("ref", place), ("query", query)):
            cv2.imwrite(str(folder / part / f"{number:04d}.jpg"), np.clip(picture, 0, 255).astype(np.uint8))
        truth.append(f"{number:04d}.jpg,{number:04d}.jpg")
    (folder / "ground_truth.csv").write_text("\n".join(truth) + "\n")


def run(folder: Path, workers: int) -> dict[str, float]:
    """Run the command that a user has; return its seconds, and the CPU seconds of all its processes."""
    before, began_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    flags = ["--data", str(folder / "generated"), "--techniques", "cohog", "--out", str(folder / "out")]
    subprocess.run([sys.executable, "-m", "edgevpr", "eval", *flags, "--workers", str(workers)], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall_s": round(time.perf_counter() - began_s, 1), "cpu_s": round(cpu_s, 1)}


def page(measured: dict) -> str:
    machine, runs = measured["machine"], measured["runs"]
    return f"""# Many sets and rows: what a measurement takes

{measured["pictures"]} queries on {measured["pictures"]} references, `cohog` as it flies ahead, with
{measured["workers"]} workers on {machine["cpu"]} with {machine["cores"]} cores (load before and
meanwhile: {measured["load"]:.1f}), on {measured["date"]}, commit
{measured["commit"]}: `python benchmarks/many_sets.py --write`.

| | wall s | CPU s of all processes |
| --- | ---: | ---: |
| the first time | {runs["first"]["wall_s"]} | {runs["first"]["cpu_s"]} |
| again, with all that is kept | {runs["again"]["wall_s"]} | {runs["again"]["cpu_s"]} |

The cache takes {measured["cache_mb"]} MB. Recall@1 of these generated pictures is {measured["recall_at_1"]:.3f}.
"""


if __name__ == "__main__":
    main()
