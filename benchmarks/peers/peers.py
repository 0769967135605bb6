"""edgevpr's `cohog` beside what a researcher would reach for first: `make peers`.

python benchmarks/peers/peers.py [--sets A,B] [--again] [--torch PYTHON]

Every way recognises the same queries among the same references, each in a process of its own; of a set one way comes
after the other, so that a busy machine is busy for all. Words are learnt on the references of sets that are not
reported. Modern networks (`modern.py`) need a Python with PyTorch and onnx, for their export alone. What was measured
is kept, each row with its commit, and a run that was broken off goes on; `--again` measures all anew. A way whose
package is missing is left out, and said.

Writes benchmarks/results/peers.json and peers.md. Words, maps and networks lie in peers_work/ (700 MB).
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(BENCHMARKS), str(BENCHMARKS.parent)]

from hostile_pictures import DATA, camera_of  # noqa: E402
from run_sets import REPOSITORY, RESULTS, TUNED_ON, find_sets, made_by  # noqa: E402

from edgevpr.core.errors import EdgevprError, UsageError  # noqa: E402
from peers import modern, page  # noqa: E402
from peers.ways import WAYS  # noqa: E402

SETS = "aerial_brighton", "aerial_copr", "aerial_swindale", "kite_ochota", "grief_stromovka_seasons", "nordland_tiny"
WORK = REPOSITORY / "peers_work"
Rows = dict[str, Any]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", default=",".join(SETS), metavar="A,B")
    parser.add_argument("--again", action="store_true", help="measure again what was measured")
    parser.add_argument("--torch", default=sys.executable, metavar="PYTHON", help="one with torch and onnx")
    args = parser.parse_args()
    try:
        folders = find_sets(DATA, args.sets.split(","))
        training = find_sets(DATA, list(TUNED_ON))
    except UsageError as error:
        print(f"peers: {str(error).replace('--data or ', '')}", file=sys.stderr)  # there is no such flag here
        return error.exit_code
    if args.again:
        shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(exist_ok=True)
    path, found = RESULTS / "peers.json", {"rows": {}, "networks": {}}
    if path.exists():
        found |= {key: json.loads(path.read_text())[key] for key in found}
    by = made_by()

    def measured(kind: str, key: str, measure: Callable[[], Rows]) -> None:
        if key in found[kind] and not args.again:
            return
        try:
            found[kind][key] = {**measure(), "commit": by["commit"]}
        except EdgevprError as error:
            print(f"{key} is left out: {error}", file=sys.stderr, flush=True)
            return
        path.write_text(json.dumps({**by, **found}, indent=1) + "\n")
        print(key, flush=True)

    for folder in folders:
        measured("rows", f"{folder.name}: {page.OURS}", lambda folder=folder: _cohog(folder))
        for way in WAYS:
            measured("rows", f"{folder.name}: {way}", lambda way=way, folder=folder: _way(way, folder, training))
    cards = modern.cards(modern.RECIPES.read_text())
    measured("networks", "calc", lambda: _network("calc", folders[0]))
    for name, card in cards.items():
        measured("networks", name, lambda name=name, card=card: _modern(name, card, folders[0], args.torch))
    measured("networks", "cosplace_int8", lambda: _in_8_bits("cosplace", folders[0]))
    (RESULTS / "peers.md").write_text(page.write({**by, **found}))
    return 0


def _cohog(folder: Path) -> Rows:
    camera, file = camera_of(folder.name), WORK / f"{folder.name}.gpkg"
    if not file.exists():
        unfinished = file.with_name(f"unfinished_{file.name}")
        unfinished.unlink(missing_ok=True)
        _one("map", camera, str(folder), str(unfinished))
        unfinished.rename(file)
    return _one("cohog", camera, str(folder), str(file))


def _way(way: str, folder: Path, training: list[Path]) -> Rows:
    words = WORK / f"{way}.words"
    if not words.exists():
        _one("learn", way, str(words), *map(str, training))
    return _one("way", way, str(folder), str(words))


def _modern(name: str, card: str, folder: Path, python: str) -> Rows:
    """Go through the recipe of a network, and measure it. It has random weights: what it recognises is not told."""
    size = modern.add(name, card, WORK, python)
    data = "--query", f"{folder}/query", "--ref", f"{folder}/ref", "--ground-truth", f"{folder}/ground_truth.csv"
    modern.edgevpr(WORK, "eval", *data, "--techniques", name, "--json")
    return {**size, **_network(name, folder)}


def _in_8_bits(name: str, folder: Path) -> Rows:
    modern.edgevpr(WORK, "models", "quantise", name, "--calibrate", f"{folder}/ref")
    return _network(f"{name}_int8", folder)


def _network(name: str, folder: Path) -> Rows:
    return _one("network", name, str(folder))


def _one(*words: str) -> Rows:
    """Do one piece of work in a process of its own. Raises EdgevprError, with its last line, where that fails."""
    path = os.pathsep.join((*sys.path[:2], os.environ.get("PYTHONPATH", "")))
    environment = {**os.environ, "PYTHONPATH": path, "EDGEVPR_MODELS": str(WORK / "models")}
    done = subprocess.run(
        [sys.executable, "-m", "peers.one", *words], capture_output=True, text=True, env=environment, cwd=BENCHMARKS
    )
    if done.returncode:
        raise EdgevprError((done.stderr.strip() or f"it ended with {done.returncode}").splitlines()[-1])
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    sys.exit(main())
