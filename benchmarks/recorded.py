"""What the recording of a flight costs, and whether recorded flights come out the same: writes
benchmarks/results/replay.json and replay.md.

python benchmarks/recorded.py [LOG ...]

A recorded flight goes on with its pictures as they are kept, as JPEG. So each set is asked with its pictures as they
are and as they are kept; and a picture is encoded and decoded in three sizes. LOGs are those of recorded flights, such
as the rig's (`benchmarks/rig/rig.py SCENARIO -- --record FOLDER`): each is replayed.
"""

import statistics
import sys
import tempfile
import time
from pathlib import Path

import base
import cv2
from base import DATA, Row

from edgevpr.frames.images import decoded, list_images, read_image
from edgevpr.frames.taped import as_jpeg
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import evaluate
from edgevpr.review.compare import compare
from edgevpr.review.replay import recorded, replay

SETS = "aerial_brighton", "aerial_swindale", "kite_ochota", "corridor"
WIDTHS_PX = 320, 640, 1280
ROUNDS = 30
_FLIGHTS = {
    "flight": "{flight}",
    "queries": "{queries}",
    "minutes": "{minutes:.1f}",
    "recording, MB": "{recording_mb:.0f}",
    "lines same / other": "{lines} / {lines_other}",
    "packets same / other": "{packets} / {packets_other}",
    "replay, s": "{replay_s:.0f}",
}
_SETS = {
    "set": "{set}",
    "queries": "{as they are[queries]}",
    "kB a picture": "{kb:.0f}",
    **{how: "{how[recall_at_1]:.3f}; {how[accepted]} ({how[accepted_wrong]} wrong)".replace("how", how)
       for how in ("as they are", "as kept")},
}  # fmt: skip


def main() -> None:
    found = base.made_by()
    found["sets"] = [_of_set(DATA / name) for name in SETS if (DATA / name).is_dir()]
    found["pictures"] = [_of_width(width_px) for width_px in WIDTHS_PX]
    found["flights"] = [_of_flight(Path(log)) for log in sys.argv[1:]]
    base.write("replay", found, page(found))
    print(page(found))


def _of_set(folder: Path) -> Row:
    row, sizes_kb = {"set": folder.name}, []
    with tempfile.TemporaryDirectory() as kept:
        for path in list_images(folder / "query"):
            jpeg = as_jpeg(read_image(path))
            sizes_kb.append(len(jpeg) / 1e3)
            (Path(kept) / path.name).write_bytes(jpeg)
        row["kb"] = statistics.median(sizes_kb)
        for name, queries in (("as they are", folder / "query"), ("as kept", Path(kept))):
            dataset = load_dataset(queries, folder / "ref", folder / "ground_truth.csv")
            result = evaluate("cohog", dataset, {"camera": base.camera_of(folder.name)})
            figures = ("queries", "recall_at_1", "accepted", "accepted_wrong")
            row[name] = {figure: getattr(result, figure) for figure in figures}
    print(row, flush=True)
    return row


def _of_width(width_px: int) -> Row:
    """Return the time of keeping one picture: the JPEG made, and read again."""
    picture, times_s = read_image(list_images(DATA / "aerial_swindale" / "query")[0]), []
    picture = cv2.resize(picture, (width_px, width_px * 3 // 4), interpolation=cv2.INTER_AREA)
    for _ in range(ROUNDS):
        begin_s = time.thread_time()
        decoded(jpeg := as_jpeg(picture))
        times_s.append(time.thread_time() - begin_s)
    return {"size_px": f"{width_px} x {width_px * 3 // 4}", "cpu_ms": 1e3 * min(times_s), "kb": len(jpeg) / 1e3}


def _of_flight(log: Path) -> Row:
    flight, begin_s = recorded(log), time.perf_counter()
    again = replay(flight, lambda done, total: None)
    took_s, lines = time.perf_counter() - begin_s, compare(flight.lines, again.lines)
    queries = [line for line in again.lines if line.get("kind") == "query"]
    row = {
        "flight": log.parent.name,
        "queries": len(queries),
        "minutes": (queries[-1]["t_mono_s"] - queries[0]["t_mono_s"]) / 60,
        "recording_mb": sum(each.stat().st_size for each in flight.folder.rglob("*") if each.is_file()) / 1e6,
        "lines": lines.alike,
        "lines_other": len(lines.others),
        "packets": again.packets.alike,
        "packets_other": len(again.packets.others),
        "why_ended": again.why_ended,
        "replay_s": took_s,
    }
    print(row, flush=True)
    return row


def page(found: Row) -> str:
    return f"""# Recording and replay

`python benchmarks/recorded.py LOG ...`, {found["date"]}, commit {found["commit"]}, {found["machine"]["cores"]} cores of
{found["machine"]["cpu"]}, OpenCV {found["machine"]["opencv"]}.

## Recorded flights, flown again

Each flight was recorded with `log.record` and replayed by the commit above: lines of its log and MAVLink packets that
come out the same to the byte, and those that differ. Those of the rig are of a real ArduPilot in simulation.

{base.table(found["flights"], _FLIGHTS)}

## Pictures as they are kept

A recorded flight goes on with its pictures as they are kept. `cohog`, compact: recall@1; accepted (wrong ones).

{base.table(found["sets"], _SETS)}

CPU time for making the JPEG and reading it again, the quickest of {ROUNDS} rounds on one core:

{base.table(found["pictures"], {"picture": "{size_px}", "kB": "{kb:.0f}", "ms": "{cpu_ms:.1f}"})}
"""


if __name__ == "__main__":
    base.run(main)
