"""Modern networks in edgevpr, by the recipes and cards of docs/how-to/modern-networks.md, with random weights.

The weights of the authors cannot be had everywhere; what a network costs does not depend on them. Each recipe is gone
through as a user would: the architecture is exported as ONNX, `edgevpr models add` tries and adds it with the card that
the page prints, `edgevpr eval` measures it, and then it is measured here.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from run_sets import REPOSITORY

from edgevpr.core.errors import EdgevprError

BENCHMARKS = REPOSITORY / "benchmarks"
RECIPES = REPOSITORY / "docs/how-to/modern-networks.md"
_CARD = re.compile(r"^`(\w+)\.yaml`:\n\n((?:    .+\n)+)", re.MULTILINE)


def cards(page: str) -> dict[str, str]:
    """Return the cards that a page prints, by name."""
    return {name: re.sub("^    ", "", card, flags=re.MULTILINE) for name, card in _CARD.findall(page)}


def add(name: str, card: str, work: Path, python: str) -> dict[str, Any]:
    """Export a network with a Python that has PyTorch, and add it to the models of a folder. Return its parameters and
    multiplications. Raises EdgevprError where that Python has no PyTorch."""
    if subprocess.run([python, "-c", "import onnx, torch"], capture_output=True).returncode:
        raise EdgevprError(f"{python} has no torch and onnx: install them, or name a Python that has them (--torch).")
    work.mkdir(parents=True, exist_ok=True)
    file, card_file = work / f"{name}.onnx", work / f"{name}.yaml"
    card_file.write_text(card)
    said = _said([python, "-W", "ignore", "-m", "peers.architectures.export", name, str(file)], BENCHMARKS)
    edgevpr(work, "models", "add", str(file), "--card", str(card_file))
    file.unlink()  # edgevpr has a copy of its own
    return json.loads(said.splitlines()[-1])


def edgevpr(work: Path, *words: str) -> str:
    """Run a command of edgevpr with the models of a folder, and return what it prints. Raises EdgevprError where it
    fails."""
    return _said([sys.executable, "-m", "edgevpr", *words], REPOSITORY, EDGEVPR_MODELS=str(work / "models"))


def _said(words: list[str], path: Path, **variables: str) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(path), os.environ.get("PYTHONPATH", "")))}
    done = subprocess.run(words, capture_output=True, text=True, env={**environment, **variables})
    if done.returncode:
        last = (done.stderr.strip() or "it said nothing").splitlines()[-1]
        raise EdgevprError(f"`{' '.join(words)}` failed ({last}): correct what it names.")
    return done.stdout
