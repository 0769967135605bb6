"""What the recording of a flight costs, and whether recorded flights come out the same: writes
benchmarks/results/replay.json and replay.md.

python benchmarks/recorded.py [LOG ...]

A recorded flight goes on with its pictures as they are kept, as JPEG. So each set is asked with its pictures as they
are and as they are kept; and a picture is encoded and decoded in three sizes. LOGs are those of recorded flights, such
as the rig's (`benchmarks/rig/rig.py SCENARIO -- --record FOLDER`): each is replayed.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
from hostile_pictures import camera_of
from run_sets import DATA, RESULTS, made_by

from edgevpr.core.text import markdown
from edgevpr.frames.images import decoded, list_images, read_image
from edgevpr.frames.taped import as_jpeg
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import evaluate
from edgevpr.review.compare import compare
from edgevpr.review.replay import recorded, replay

SETS = "aerial_brighton", "aerial_swindale", "kite_ochota", "corridor"
WIDTHS_PX = 320, 640, 1280
ROUNDS = 30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("logs", nargs="*", metavar="LOG", help="of recorded flights")
    logs = parser.parse_args().logs
    found = {
        **made_by(),
        "sets": [_of_set(DATA / name) for name in SETS if (DATA / name).is_dir()],
        "pictures": [_of_width(width_px) for width_px in WIDTHS_PX],
        "flights": [_of_flight(Path(log)) for log in logs],
    }
    (RESULTS / "replay.json").write_text(json.dumps(found, indent=2) + "\n")
    page = _page(found)
    (RESULTS / "replay.md").write_text(page)
    print(page)


def _of_set(folder: Path) -> dict[str, Any]:
    row: dict[str, Any] = {"set": folder.name, "kb": []}
    with tempfile.TemporaryDirectory() as temporary:
        kept = Path(temporary)
        for path in list_images(folder / "query"):
            jpeg = as_jpeg(read_image(path))
            row["kb"].append(len(jpeg) / 1e3)
            (kept / path.name).write_bytes(jpeg)
        for name, queries in (("as they are", folder / "query"), ("as kept", kept)):
            dataset = load_dataset(queries, folder / "ref", folder / "ground_truth.csv")
            result = evaluate("cohog", dataset, {"camera": camera_of(folder.name)})
            row[name] = {
                "queries": len(dataset.queries),
                "recall_at_1": result.recall_at_1,
                "accepted": result.accepted,
                "accepted_wrong": result.accepted_wrong,
            }
    row["kb"] = statistics.median(row["kb"])
    print(row, flush=True)
    return row


def _of_width(width_px: int) -> dict[str, Any]:
    """Time of keeping one picture: the JPEG made, and read again."""
    picture = read_image(list_images(DATA / "aerial_swindale" / "query")[0])
    picture = cv2.resize(picture, (width_px, width_px * 3 // 4), interpolation=cv2.INTER_AREA)
    times_s, jpeg = [], b""
    for _ in range(ROUNDS):
        begin_s = time.thread_time()
        jpeg = as_jpeg(picture)
        decoded(jpeg)
        times_s.append(time.thread_time() - begin_s)
    return {"size_px": f"{width_px} x {width_px * 3 // 4}", "cpu_ms": 1e3 * min(times_s), "kb": len(jpeg) / 1e3}


def _of_flight(log: Path) -> dict[str, Any]:
    flight = recorded(log)
    begin_s = time.perf_counter()
    again = replay(flight, lambda done, total: None)
    took_s = time.perf_counter() - begin_s
    lines = compare(flight.lines, again.lines)
    queries = [line for line in again.lines if line.get("kind") == "query"]
    size_mb = sum(each.stat().st_size for each in flight.folder.rglob("*") if each.is_file()) / 1e6
    row = {
        "flight": log.parent.name,
        "queries": len(queries),
        "minutes": (queries[-1]["t_mono_s"] - queries[0]["t_mono_s"]) / 60,
        "recording_mb": size_mb,
        "lines": lines.alike,
        "lines_other": len(lines.others),
        "packets": again.packets.alike,
        "packets_other": len(again.packets.others),
        "why_ended": again.why_ended,
        "replay_s": took_s,
    }
    print(row, flush=True)
    return row


def _page(found: dict[str, Any]) -> str:
    sets = [
        (
            row["set"],
            str(row["as they are"]["queries"]),
            f"{row['kb']:.0f}",
            *(
                f"{row[how]['recall_at_1']:.3f}; {row[how]['accepted']} ({row[how]['accepted_wrong']} wrong)"
                for how in ("as they are", "as kept")
            ),
        )
        for row in found["sets"]
    ]
    pictures = [(row["size_px"], f"{row['kb']:.0f}", f"{row['cpu_ms']:.1f}") for row in found["pictures"]]
    titles = "flight", "queries", "minutes", "recording, MB", "lines same / other", "packets same / other", "replay, s"
    flights = [
        (
            row["flight"],
            str(row["queries"]),
            f"{row['minutes']:.1f}",
            f"{row['recording_mb']:.0f}",
            f"{row['lines']} / {row['lines_other']}",
            f"{row['packets']} / {row['packets_other']}",
            f"{row['replay_s']:.0f}",
        )
        for row in found["flights"]
    ]
    return f"""# Recording and replay

`python benchmarks/recorded.py LOG ...`, {found["date"]}, commit {found["commit"]}, {found["machine"]["cores"]} cores of
{found["machine"]["cpu"]}, OpenCV {found["machine"]["opencv"]}.

## Recorded flights, flown again

Each flight was recorded with `log.record` and replayed by the commit above: lines of its log and MAVLink packets that
come out the same to the byte, and those that differ. Those of the rig are of a real ArduPilot in simulation.

{markdown(titles, flights)}

## Pictures as they are kept

A recorded flight goes on with its pictures as they are kept. `cohog`, compact: recall@1; accepted (wrong ones).

{markdown(("set", "queries", "kB a picture", "as they are", "as kept"), sets)}

CPU time for making the JPEG and reading it again, the quickest of {ROUNDS} rounds on one core:

{markdown(("picture", "kB", "ms"), pictures)}
"""


if __name__ == "__main__":
    main()
