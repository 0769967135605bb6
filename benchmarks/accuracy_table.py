"""What of the results travels with the program: how well each technique recognises, by the way the camera looks."""

import json
from typing import Any

import sets_page

from edgevpr.runtime.preflight.accuracy import PATH

# Rows that no board is offered: other weights, another way to match, or a comparison with everything.
NOT_OFFERED = ("exact", "thesis", "sequence", "one frame", "original weights")


def write(contents: list[dict[str, Any]], looks_down: dict[str, bool], all_joined: str) -> None:
    """Write the table of the contents of all result files. `looks_down` tells which sets are from the air;
    `all_joined` is the set that repeats others."""
    found: dict[str, dict[str, Any]] = {"forward": {}, "nadir": {}}
    for camera, table in found.items():
        of_camera = [each for each in contents if looks_down[each["set"]] == (camera == "nadir")]
        of_camera = [each for each in of_camera if each["set"] != all_joined]
        for label in dict.fromkeys(label for each in of_camera for label in each["techniques"]):
            if not any(word in label for word in NOT_OFFERED):
                having = [each for each in of_camera if label in each["techniques"]]
                table[label] = row([(each["use"], each["techniques"][label]) for each in having])
    PATH.write_text(json.dumps(found, indent=1) + "\n")


def row(measured: list[tuple[str, dict[str, Any]]]) -> dict[str, Any]:
    """One row: recall is that of the sets that are reported, what was accepted that of all."""
    reported = [result for use, result in measured if use == "report"]
    results = [result for _, result in measured]
    return {
        "recall_at_1": round(sum(result["recall_at_1"] for result in reported) / len(reported), 4),
        "sets": len(reported),
        "queries": sum(result["queries"] for result in reported),
        "asked": sum(result["queries"] for result in results),
        "accepted": sum(result["accepted"] for result in results),
        "accepted_wrong": sum(result["accepted_wrong"] for result in results),
        "accepted_elsewhere": sum(sets_page.result(result).accepted_elsewhere for result in results),
    }
