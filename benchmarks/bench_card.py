"""What a query reads from the map file when nothing of it is cached, as after a start, and the time that takes on a
slow card. Bytes are those that the kernel fetched from the disk for this process (`read_bytes` of /proc/self/io).

How much the kernel reads ahead decides most of it. As root the disk is set to what Raspberry Pi OS has, for the time of
the measurement.
"""

import os

import base  # noqa: F401

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
from bench_encode import frames
from bench_flight import forget_pages
from big_map import make_big_map

from edgevpr.core.tables import markdown
from edgevpr.places.index import load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import compare, scan
from edgevpr.techniques import create

PLACES = 10_000
CARD_MB_PER_S = 20.0
READ_AHEAD_KB = 128  # of a card under Raspberry Pi OS: the kernel's own default
TURNS = 5


def rows(places: int = PLACES) -> list[dict]:
    """Return for each camera how many places a query read, the largest MB read of some queries, and the seconds on the
    card."""
    found = []
    for camera in ("forward", "nadir"):
        technique = create("cohog", {"camera": camera})
        # A disk, where /tmp may be memory.
        with TemporaryDirectory(dir=Path(__file__).parent) as folder, read_ahead(Path(folder)) as ahead_kb:
            path = Path(folder) / "big.gpkg"
            make_big_map(path, technique.spec, places)
            with PlaceMap.open(path) as place_map:
                index = load_index(place_map, technique, 100_000_000)
                read_mb = []
                for picture in (cv2.flip(frames()[0], 1), *frames()[: TURNS - 1]):
                    asked = technique.encode(picture)
                    scanned = scan(technique, asked, index)
                    forget_pages(path)
                    before = read_bytes()
                    compare(technique, asked, scanned, place_map, index, candidates=technique.candidates)
                    read_mb.append((read_bytes() - before) / 1e6)
        mb = max(read_mb)
        found.append({"camera": camera, "read_ahead_kb": ahead_kb, "read_mb": mb, "card_s": mb / CARD_MB_PER_S})
    return found


@contextmanager
def read_ahead(folder: Path) -> Iterator[int]:
    """Set how much is read ahead from the disk of a folder, where that is allowed; yields what is in force, in KB."""
    device = os.stat(folder).st_dev
    disk = Path(f"/sys/dev/block/{os.major(device)}:{os.minor(device)}").resolve()
    setting = next(each / "queue/read_ahead_kb" for each in (disk, disk.parent) if (each / "queue").is_dir())
    before = setting.read_text()
    if os.access(setting, os.W_OK):
        setting.write_text(str(READ_AHEAD_KB))
    try:
        yield int(setting.read_text())
    finally:
        if os.access(setting, os.W_OK):
            setting.write_text(before)


def read_bytes() -> int:
    """Bytes that this process has caused to be fetched from a disk."""
    fields = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(fields["read_bytes"])


def table(results: list[dict]) -> str:
    """The results as a Markdown table."""
    rows = [
        [row["camera"], str(row["read_ahead_kb"]), f"{row['read_mb']:.1f}", f"{row['card_s']:.2f}"] for row in results
    ]
    return markdown(("a query", "KB read ahead", "MB read", "s on the card"), rows)


if __name__ == "__main__":
    print(table(rows()))
