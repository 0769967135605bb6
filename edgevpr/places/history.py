"""History of a map that several flights have made: the flights, the pictures that are no places of it any more, and the
layer of spots where a later flight did not find earlier ground. Any program shows these tables of the GeoPackage; a
flight does not read them, and copies of the map (`examine`) have none.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from edgevpr.core.types import Position
from edgevpr.places.geopackage import CHANGES, GROW_EXTENT, HISTORY, point_blob, utc_text
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapfiles import sentences

_COUNTS = "SELECT (SELECT count(*) FROM passes), count(place_id), count(*), (SELECT count(*) FROM changes) FROM removed"


@dataclass(frozen=True, slots=True)
class FlownPass:
    """A flight: the name of its folder, and when its first and last picture were taken (seconds since 1970; None:
    unknown)."""

    name: str
    first_s: float | None
    last_s: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundChange:
    """A spot where the picture `to_image`, taken at `to_s`, did not find the place of `from_image`, taken at `from_s`
    (seconds since 1970). `confidence`: 0..1, that it reached there."""

    position: Position
    from_s: float
    to_s: float
    confidence: float
    from_image: str
    to_image: str


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """The flights that were compared (none: there was nothing to compare). `removed`: names of pictures that are no
    places any more, with the number of the place that each is part of (None: it has faded)."""

    passes: tuple[FlownPass, ...] = ()
    removed: Mapping[str, int | None] = field(default_factory=dict)
    changes: tuple[GroundChange, ...] = ()


def write_history(place_map: PlaceMap, history: History) -> None:
    """Write the history of a map that is open for adding and has none yet; nothing, if no flights were compared. Raises
    MapError."""
    db = place_map.db
    if not history.passes:
        return
    with place_map.transaction():
        for statement in HISTORY:
            db.execute(statement)
        passes = ((each.name, utc_text(each.first_s), utc_text(each.last_s)) for each in history.passes)
        db.executemany("INSERT INTO passes (name, first_time, last_time) VALUES (?, ?, ?)", passes)
        db.executemany("INSERT INTO removed (source_image, place_id) VALUES (?, ?)", sorted(history.removed.items()))
        db.executemany(f"INSERT INTO changes ({CHANGES}) VALUES (?, ?, ?, ?, ?, ?)", map(_row_of, history.changes))
        for at in (change.position for change in history.changes):
            db.execute(GROW_EXTENT, {"table": "changes", "lat": at.lat_deg, "lon": at.lon_deg})


def _row_of(change: GroundChange) -> tuple[bytes, str | None, str | None, float, str, str]:
    at, times = change.position, (utc_text(change.from_s), utc_text(change.to_s))
    return point_blob(at.lat_deg, at.lon_deg), *times, change.confidence, change.from_image, change.to_image


def read_counts(place_map: PlaceMap) -> dict[str, int]:
    """Count the flights compared (`passes`), the places that became part of another (`merged`) or have `faded`, and the
    spots `changed`; empty for a map without a history. Raises MapError."""
    if not _has_history(place_map):
        return {}
    with sentences(place_map.path):
        passes, merged, removed, changed = place_map.db.execute(_COUNTS).fetchone()
    return {"passes": passes, "merged": merged, "faded": removed - merged, "changed": changed}


def drop_places(place_map: PlaceMap) -> list[str]:
    """Return the names of the pictures that are no places of a map any more. Raises MapError."""
    if not _has_history(place_map):
        return []
    with sentences(place_map.path):
        return [str(name) for (name,) in place_map.db.execute("SELECT source_image FROM removed")]


def _has_history(place_map: PlaceMap) -> bool:
    with sentences(place_map.path):
        query = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('passes', 'removed', 'changes')"
        return bool(place_map.db.execute(query).fetchone()[0] == 3)
