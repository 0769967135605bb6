"""Extracts the pictures of videos with positions into folders, for data sets.

The positions of a video are in a table of its name beside it (later.csv of later.mp4, see `frames.positions`).
"""

import tempfile
from pathlib import Path

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.frames.images import is_image, write_png
from edgevpr.frames.positions import MOST_GAP_S, GeoTag, find_track, write_positions
from edgevpr.frames.source import open_source
from edgevpr.lab.evaluate.evaluate import Progress, read_frames
from edgevpr.lab.evaluate.provenance import hash_parts, stamp_file

_COLUMNS = "time,lat,lon[,alt,yaw_deg,roll_deg,pitch_deg,height_m], `time` in seconds from its first frame"


def extract_pictures(given: Path, cache: Path, rate_hz: float | None, progress: Progress) -> Path:
    """Return `given` if it is a folder of pictures, and of a video a folder of its pictures that have a position, with
    positions.csv. From a video `rate_hz` pictures a second are taken (None: every frame) and kept below the folder
    `cache`. Raises UsageError for a video without positions, ImageError for a damaged one, SourceError for a file that
    is no video, and EdgevprError for a full disk."""
    if not given.is_file() or is_image(given.name):
        return given
    if (table := find_track(given)) is None:
        raise UsageError(f"{given} has no positions beside it: write {given.stem}.csv there ({_COLUMNS}).")
    folder = cache / hash_parts(given, stamp_file(given), stamp_file(table), rate_hz)
    if folder.is_dir():
        return folder
    source = open_source(str(given), step_s=1 / rate_hz if rate_hz else None, positions=table, live=False)
    tags: dict[str, GeoTag] = {}
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".", dir=cache) as temporary:
            unfinished = Path(temporary) / "pictures"
            unfinished.mkdir()
            for frame in progress(read_frames(source), source.total, f"{given.name}: pictures"):
                if frame.position:
                    # Like frame_000006_t0.240_s.png: a space would separate names in a ground truth.
                    name = frame.name.replace("=", "").replace(" ", "_") + ".png"
                    tags[name] = GeoTag(
                        position=frame.position,
                        heading_deg=frame.heading_deg,
                        roll_deg=frame.roll_deg,
                        pitch_deg=frame.pitch_deg,
                        height_m=frame.height_m,
                    )
                    write_png(unfinished / name, frame.image)
            if not tags:
                raise UsageError(
                    f"No frame of {given} lies between two lines of {table} that are at most {MOST_GAP_S:g} s apart: "
                    "write `time` in seconds from its first frame."
                )
            write_positions(unfinished / "positions.csv", tags)
            unfinished.rename(folder)  # only a complete folder is found by the next run
    except OSError as error:
        raise EdgevprError(
            f"{cache} takes no more pictures of {given} ({error.strerror}): make room, take fewer with --rate-hz, or "
            "name another folder with --out."
        ) from error
    finally:
        source.close()
    return folder
