"""Values out of the lines of a log that somebody may have damaged or edited: of the type that is asked for, or None."""

from typing import Any

Point = tuple[float, float]  # latitude and longitude, degrees
_MOST = 1e15  # what is larger is no figure of a flight; comparing excludes NaN, and integers that no float can hold


def value(record: Any, *keys: str) -> Any:
    """Return what stands under `keys`, one inside the other; None where anything is missing."""
    for key in keys:
        record = record.get(key) if isinstance(record, dict) else None
    return record


def number(record: Any, *keys: str) -> float | None:
    """Return a number, as `value` finds it."""
    found = value(record, *keys)
    is_number = isinstance(found, (int, float)) and not isinstance(found, bool)
    return float(found) if is_number and -_MOST < found < _MOST else None


def text(record: Any, *keys: str) -> str | None:
    """Return a text, as `value` finds it; None for an empty one."""
    found = value(record, *keys)
    return found if isinstance(found, str) and found else None


def point(record: Any, *keys: str) -> Point | None:
    """Return the position (lat_deg, lon_deg) of the object under `keys`; None where it has none on the Earth."""
    lat_deg, lon_deg = number(record, *keys, "lat_deg"), number(record, *keys, "lon_deg")
    if lat_deg is None or lon_deg is None or abs(lat_deg) > 90 or abs(lon_deg) > 180:
        return None
    return lat_deg, lon_deg
