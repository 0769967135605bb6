"""Flight logs of edgevpr: where the pictures of a recorded flight were taken, as the autopilot reported with GPS."""

from contextlib import suppress
from pathlib import Path
from typing import Any

from edgevpr.core.errors import UsageError
from edgevpr.frames.positions import GeoTag
from edgevpr.runtime.flight.recording import has_live_source, list_frames, read_recorded
from edgevpr.tracks.record import Record, make_tag

_MAX_REPORT_AGE_S = 1.0
# For this long after a fix that the autopilot may have accepted, its position may be only an echo of that fix.
_FIX_ECHO_S = 10.0


def read_flight(path: Path) -> Record:
    """Read the tags of the last flight in a log, by picture name in the folder `frames` of its recording. A picture
    has no position if the autopilot had no GPS, or if its report was old or may be only an echo of our fix. Raises
    UsageError if no flight with a camera was recorded, and EdgevprError if the log has no flight."""
    lines, folder = read_recorded(path)
    if not has_live_source(folder):
        raise UsageError(
            f"{path}: the images are from a folder or a video, not from a camera on that flight: use the log or track "
            "of the flight on which they were taken."
        )
    files, tags_by_name = list_frames(folder), dict[str, GeoTag]()
    for line in lines:
        if line.get("kind") == "query" and (file := files.get(str(line.get("query")))):
            with suppress(KeyError, TypeError):  # a damaged line, or one without a vehicle
                if tag := _read_tag(line["vehicle"], line["t_frame_s"]):
                    tags_by_name[file.name] = tag
    return Record(kind="flight log of edgevpr", tags_by_name=tags_by_name)


def _read_tag(vehicle: dict[str, Any], t_frame_s: float) -> GeoTag | None:
    t_fix_s = vehicle["t_fix_s"]
    is_echo = t_fix_s is not None and t_frame_s - t_fix_s < _FIX_ECHO_S
    if not vehicle["has_gps"] or is_echo or abs(t_frame_s - vehicle["t_received_s"]) > _MAX_REPORT_AGE_S:
        return None
    attitude = vehicle["heading_deg"], vehicle["roll_deg"], vehicle["pitch_deg"]
    return make_tag(vehicle["lat_deg"], vehicle["lon_deg"], vehicle["alt_m"], attitude, vehicle["height_m"])
