"""The start of a flight: opens the recogniser and makes the first line of the flight log."""

import logging
import math
import platform
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from statistics import median
from typing import Any

from edgevpr import __version__
from edgevpr.core.config import MAX_RATE_HZ, MIN_RATE_HZ, Config, SourceConfig
from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.types import Position
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapinfo import read_identity
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.flight.flightio import FlightIO
from edgevpr.runtime.preflight.pick import explain_technique
from edgevpr.runtime.recognise.levelling import read_camera_lens
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.runtime.recognise.recogniser import Recogniser

_ORIGIN_PLACES = 15  # first places of the map, used for the ground altitude
_LIBRARIES = ("numpy", "cv2", "onnxruntime")

_log = logging.getLogger(__name__)


def open_map(config: Config, io: FlightIO) -> Recogniser:
    """Open the recogniser of a flight, metered with the clocks of the flight. Raises EdgevprError."""
    meter = QueryMeter(
        io.board,
        config.battery,
        wall_clock=io.clock.wall_s,
        cpu_clock=io.clock.process_cpu_s,
        memory_mb=io.machine.rss_mb,
    )
    config = replace(config, map=io.place_map)
    return open_recogniser(config, io.board, uses_hints=True, tracks_flight=config.match.follow, meter=meter)


def apply_recorded_rate(source: SourceConfig, steps_s: Sequence[float]) -> SourceConfig:
    """Return the settings of a source with the median rate of a recording whose pictures are `steps_s` apart (empty:
    the configured rate)."""
    if not steps_s:
        return source
    median_hz = 1 / median(step_s for step_s in steps_s if step_s > 0)
    return replace(source, rate_hz=min(max(median_hz, MIN_RATE_HZ), MAX_RATE_HZ))


def find_origin(place_map: PlaceMap, source: SourceConfig) -> Position | None:
    """Return the first position of a map (None: it has none), at the altitude of the ground: the median, over the first
    places, of the camera's altitude minus its height (from footprint and lens). The altitude is None if unknown."""
    first, altitudes_m, lens = None, [], read_camera_lens(source)
    has_lens_of_map = place_map.lens is None or place_map.lens == (source.lens and Path(source.lens).name)
    with suppress(PlaceError):  # a damaged place ends the search
        for place in islice((place for place in place_map.read_places() if place.position), _ORIGIN_PLACES):
            position, pose = place.position, place.pose
            first = first or position
            if position and position.alt_m is not None and pose and not pose.is_surveyed and lens and has_lens_of_map:
                height_m = pose.footprint_m / (2 * math.tan(math.radians(lens.fov_deg) / 2))
                altitudes_m.append(position.alt_m - height_m)
    return first and Position(first.lat_deg, first.lon_deg, median(altitudes_m) if altitudes_m else None)


def log_start(config: Config, io: FlightIO, recogniser: Recogniser) -> dict[str, Any]:
    """Log the technique in use, and whether power is estimated. Return the fields of the first line of the log."""
    board = io.board
    _log.info("version %s on %s", __version__, board.title)
    reason = explain_technique(recogniser, is_named=config.technique is not None)
    _log.info("%s", reason)
    if not board.verified:
        _log.warning("mAh figures are estimates: the power draw of %s is unverified (%s)", board.title, board.source)
    decided = {
        "reason": reason,
        "rule": recogniser.rule,
        "candidates": recogniser.candidates,
        "sequence": recogniser.sequence,
        "accuracy_m": recogniser.accuracy_m,
        "rate_hz": board.rate_hz,
        "idle_w": board.idle_w,
        "full_w": board.full_w,
        "power_verified": board.verified,
        "dry_run": not config.mavlink.send_fixes,
    }
    fields = start_fields(config, board.name, recogniser.technique.spec, recogniser.place_map)
    return {**fields, "recording": io.recording, "decided": decided}


def start_fields(config: Config, board_name: str, spec: TechniqueSpec, place_map: PlaceMap) -> dict[str, Any]:
    """Return the fields of a flight log's first line (kind "start"): all that affects a flight, except its input."""
    versions = {name: getattr(sys.modules.get(name), "__version__", None) for name in _LIBRARIES}
    return {
        "version": __version__,
        "technique": spec.name,
        "parameters": spec.parameters,
        "model_sha256": spec.model_sha256,
        "board": board_name,
        "machine": platform.machine(),
        "python": platform.python_version(),
        "libraries": {name: version for name, version in versions.items() if version},
        "map": config.map,
        "map_identity": _identify_map(place_map),
        "config": asdict(config),
    }


def _identify_map(place_map: PlaceMap) -> dict[str, Any] | None:
    """Return the identity of a map; None if it cannot be identified."""
    try:
        return read_identity(place_map)
    except MapError as error:  # the flight uses the places that can be read
        _log.warning("the flight log does not identify the map: %s", error)
        return None
