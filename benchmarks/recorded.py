"""Whether recorded flights come out the same: writes benchmarks/results/replay.json and replay.md.

python benchmarks/recorded.py LOG ...

LOGs are those of recorded flights, such as the rig's (`benchmarks/rig/rig.py SCENARIO -- --record FOLDER`): each is
replayed.
"""

import sys
import time
from pathlib import Path

import base
from base import Row

from edgevpr.review.compare import compare
from edgevpr.review.replay import replay

_FLIGHTS = {
    "flight": "{flight}",
    "queries": "{queries}",
    "minutes": "{minutes:.1f}",
    "recording, MB": "{recording_mb:.0f}",
    "lines same / other": "{lines} / {lines_other}",
    "packets same / other": "{packets} / {packets_other}",
    "replay, s": "{replay_s:.0f}",
}


def main() -> None:
    found = base.made_by()
    found["flights"] = [_of_flight(Path(log)) for log in sys.argv[1:]]
    base.write("replay", found, page(found))


def _of_flight(log: Path) -> Row:
    begin_s = time.perf_counter()
    again = replay(log)
    took_s, lines = time.perf_counter() - begin_s, compare(again.flown, again.lines)
    queries = [line for line in again.lines if line.get("kind") == "query"]
    return {
        "flight": log.parent.name,
        "queries": len(queries),
        "minutes": (queries[-1]["t_mono_s"] - queries[0]["t_mono_s"]) / 60,
        "recording_mb": sum(each.stat().st_size for each in again.folder.rglob("*") if each.is_file()) / 1e6,
        "lines": lines.alike,
        "lines_other": len(lines.others),
        "packets": again.packets.alike,
        "packets_other": len(again.packets.others),
        "why_ended": again.why_ended,
        "replay_s": took_s,
    }


def page(found: Row) -> str:
    return f"""# Recording and replay

`python benchmarks/recorded.py LOG ...`, {found["date"]}, commit {found["commit"]}, {found["machine"]["cores"]} cores of
{found["machine"]["cpu"]}, OpenCV {found["machine"]["opencv"]}.

## Recorded flights, flown again

Each flight was recorded with `log.record` and replayed by the commit above: lines of its log and MAVLink packets that
come out the same to the byte, and those that differ. Those of the rig are of a real ArduPilot in simulation.

{base.table(found["flights"], _FLIGHTS)}

A recorded flight goes on with its pictures as they are kept, as JPEG. Of 180 queries of four sets `cohog` accepted as
many with them as with the pictures as they were, none wrong, and missed one place more (commit 4382948).
"""


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
