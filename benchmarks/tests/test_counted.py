"""The instructions by which ARM boards are estimated, from those that were counted under emulation."""

import json
from pathlib import Path

from arm64 import counted

from edgevpr.runtime.preflight.scale import COUNTED_PATH


def test_the_counts_that_travel_are_those_of_the_benchmark():
    results = json.loads((Path(counted.__file__).parents[1] / "results" / "arm64.json").read_text())
    parts = {row["part"]: row["instructions"] for row in results["parts"]}
    assert counted.figures(parts) == json.loads(COUNTED_PATH.read_text())
