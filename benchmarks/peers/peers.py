"""edgevpr's `cohog` beside what a researcher would reach for first: writes benchmarks/results/peers.json and peers.md.

python benchmarks/peers/peers.py [--sets A,B]

Every way recognises the same queries among the same references, each in a process of its own; of a set one way comes
after the other, so that a busy machine is busy for all. Words are learnt on the references of sets that are not
reported. What was measured is kept, and a run that was broken off goes on; `--again` measures all anew.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(BENCHMARKS), str(BENCHMARKS.parent)]

from hostile_pictures import DATA, camera_of  # noqa: E402
from run_sets import RESULTS, TUNED_ON, made_by  # noqa: E402

from edgevpr.helpers.tables import markdown  # noqa: E402
from peers.ways import WAYS  # noqa: E402

COSTS = "t_e ms", "t_m ms", "B/place", "RAM MB", "import s"
OURS = "cohog (edgevpr)"
SETS = "aerial_brighton", "aerial_copr", "aerial_swindale", "kite_ochota", "grief_stromovka_seasons", "nordland_tiny"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", default=",".join(SETS), metavar="A,B")
    parser.add_argument("--again", action="store_true", help="measure again what was measured")
    args = parser.parse_args()
    path = RESULTS / "peers.json"
    rows = json.loads(path.read_text())["rows"] if path.exists() and not args.again else {}
    for name in args.sets.split(","):
        for way in (OURS, *WAYS):
            if f"{name}: {way}" in rows:
                continue
            row = _measured(way, DATA / name)
            if row:
                rows[f"{name}: {way}"] = row
                path.write_text(json.dumps({**made_by(), "rows": rows}, indent=2) + "\n")
                print(f"{name}: {way}: {row['quality']['recall_at_1']:.3f}", flush=True)
    found = {**made_by(), "rows": rows}
    (RESULTS / "peers.md").write_text(_page(found))


def _measured(way: str, folder: Path) -> dict[str, Any] | None:
    """Measure one way on one set in a process of its own; None, and a line, where that fails."""
    training = [DATA / name for name in TUNED_ON]
    camera = camera_of(folder.name)
    words = [way, camera, str(folder), *map(str, training)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path[:2])}
    done = subprocess.run(
        [sys.executable, "-m", "peers.one", *words], capture_output=True, text=True, env=environment, cwd=BENCHMARKS
    )
    if done.returncode:
        print(f"{folder.name}: {way}: {done.stderr.strip().splitlines()[-1]}", file=sys.stderr)
        return None
    return json.loads(done.stdout.splitlines()[-1])


def _page(found: dict[str, Any]) -> str:
    machine, sections = found["machine"], []
    names = dict.fromkeys(key.partition(": ")[0] for key in found["rows"])
    for name in names:
        rows = {key.partition(": ")[2]: row for key, row in found["rows"].items() if key.startswith(f"{name}: ")}
        first = next(iter(rows.values()))["quality"]
        lines = [
            (
                way,
                f"{row['quality']['recall_at_1']:.3f}",
                "{:.2f}-{:.2f}".format(*row["quality"]["recall_at_1_interval"]),
                f"{row['quality']['recall_at_5']:.3f}",
                f"{row['quality']['precision_at_100_recall']:.3f}",
                f"{row['quality']['recall_at_100_precision']:.3f}",
                f"{row['quality']['auc']:.3f}",
                f"{row['t_encode_ms']:.1f}",
                f"{row['t_match_ms']:.1f}",
                f"{row['bytes']:,.0f}",
                f"{row['ram_mb']:.0f}",
                f"{row['import_s']:.2f}",
            )
            for way, row in rows.items()
        ]
        titles = "way", "recall@1", "95 %", "@5", "P@100%R", "R@100%P", "AUC", *COSTS
        sections.append(
            f"## {name}\n\n{first['queries']} queries, {first['references']} references.\n\n{markdown(titles, lines)}\n"
        )
    return f"""# Beside other ways

`python benchmarks/peers/peers.py`, {found["date"]}, commit {found["commit"]}, {machine["cores"]} cores of
{machine["cpu"]}, OpenCV {machine["opencv"]}.

Times are those of the processor, on one thread, medians over the queries; a match is with all references. `B/place` is
what the index takes in memory: for the published CoHOG and for ORB that is the whole descriptor of every reference.
`RAM` is the peak of the process above the bare interpreter, with the references in it. Words (bag of words, VLAD) are
learnt on the references of {", ".join(TUNED_ON)}, which are not reported. The 95 % are of recall@1: what other queries
of the same kind would give.

{chr(10).join(sections)}"""


if __name__ == "__main__":
    main()
