"""The table edgevpr_map of a map file, which stores the format version and the technique that made the descriptors."""

import json
import math
import sqlite3
import uuid
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr import __version__
from edgevpr.core.contract import PartSpec, TechniqueSpec
from edgevpr.core.errors import MapError
from edgevpr.places import geopackage, rows

FORMAT_VERSION = 1
_PRERELEASE_VERSION = 4  # format version in maps made before the first release; their format is the same
_DTYPES = ("|i1", "|u1", "<i1", "<u1", *(f"<{kind}{size}" for kind in "iu" for size in "248"), "<f2", "<f4", "<f8")
_MAX_PART_BYTES = 64_000_000
_PARTS = ("coarse", "fine", "packed")
_OPTIONAL_KEYS = ("mask_sha256", "lens", "attribution", "calibration")  # of texts, which `PlaceMap` reads
_MAX_STORED = 1000  # rows read from the table, and characters of a damaged value in a message

Stored = dict[str, Any]  # the JSON values of the table, by key


def write_spec(db: sqlite3.Connection, spec: TechniqueSpec) -> None:
    """Fill the table edgevpr_map, which must exist and be empty, for a new map of `spec`. Raises sqlite3.Error."""
    values = {
        "format_version": FORMAT_VERSION,
        "map_id": uuid.uuid4().hex,
        "made_by": f"edgevpr {__version__}",
        "technique": spec.name,
        "parameters": spec.parameters,
        "model_sha256": spec.model_sha256,
        **{part: getattr(spec, part) and asdict(getattr(spec, part)) for part in _PARTS},
    }
    entries = [(key, json.dumps(value)) for key, value in values.items()]
    db.executemany("INSERT INTO edgevpr_map (key, value) VALUES (?, ?)", entries)


def read_stored(path: Path, db: sqlite3.Connection) -> Stored:
    """Return the values of edgevpr_map by key, without `_OPTIONAL_KEYS`, and check the columns of `places`. Raises
    MapError for a file that is not a place map or has an unknown format version, and sqlite3.Error."""
    (application_id,) = db.execute("PRAGMA application_id").fetchone()
    # A view or virtual table, which has no page of its own in the file, is rejected: a query of it may never end.
    tables = {name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0")}
    if application_id != geopackage.APPLICATION_ID or not {"edgevpr_map", "places"} <= tables:
        raise MapError(f"{path}: this is not a place map: use a .gpkg file made by `edgevpr map build`.")
    try:
        # The optional keys are read only when needed: a map can be used without them.
        entries = db.execute("SELECT key, value FROM edgevpr_map WHERE key NOT IN (?, ?, ?, ?)", _OPTIONAL_KEYS)
        stored = {key: json.loads(value) for key, value in entries.fetchmany(_MAX_STORED)}
        version = stored["format_version"]
        if not isinstance(version, int) or version < 1:
            raise ValueError(f"invalid format version {version}")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise _make_damage_error(path, error) from error
    if version not in (FORMAT_VERSION, _PRERELEASE_VERSION):
        raise MapError(
            f"{path} has map format {version}, but this version of edgevpr reads {FORMAT_VERSION}: update edgevpr, or "
            "build the map again."
        )
    _require_columns(path, db)
    return stored


def read_spec(path: Path, stored: Stored) -> TechniqueSpec:
    """Return the specification of the technique that made the map, from `stored`. Raises MapError if it is invalid."""
    try:
        name, parameters, model = stored["technique"], dict(stored["parameters"]), stored["model_sha256"]
        coarse, fine, packed = (_parse_part_spec(stored[part]) for part in _PARTS)
        if coarse is None or not isinstance(name, str) or not isinstance(model, str | None):
            raise ValueError("no coarse part, or the name of technique or network is not text")
        if not all(isinstance(value, int | str) or math.isfinite(value) for value in parameters.values()):
            raise ValueError(f"invalid parameters {parameters!r}")
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise _make_damage_error(path, error) from error
    return TechniqueSpec(name=name, parameters=parameters, coarse=coarse, fine=fine, model_sha256=model, packed=packed)


def list_differences(stored: TechniqueSpec, current: TechniqueSpec) -> list[str]:
    """Return one phrase for each difference between the `stored` and the `current` technique; empty if equal."""
    if stored.name != current.name:
        return [f"technique is {stored.name}, not {current.name}"]
    old, new = (
        {**spec.parameters, "model sha256": spec.model_sha256, "coarse part": spec.coarse, "fine part": spec.fine}
        for spec in (stored, current)
    )
    return [f"{name} is {old.get(name)}, not {new.get(name)}" for name in old | new if old.get(name) != new.get(name)]


def _require_columns(path: Path, db: sqlite3.Connection) -> None:
    """Raise MapError unless the table of places has all required columns."""
    # `table_info` omits generated columns, rightly: computed when read, they could have any size.
    columns = {name: (kind, key) for _, name, kind, _, _, key in db.execute("PRAGMA table_info(places)")}
    missing = [name for name in rows.ALL_COLUMNS.split(", ") if name not in columns]
    if columns.get("place_id") != ("INTEGER", 1):
        missing.append("place_id")
    if missing:
        raise MapError(
            f"{path}: its table of places lacks required columns ({', '.join(missing)}): restore a copy or build the "
            "map again."
        )


def _make_damage_error(path: Path, error: Exception) -> MapError:
    problem = repr(error)[:_MAX_STORED]
    return MapError(f"{path}: its table edgevpr_map is damaged ({problem}): restore a copy or build the map again.")


def _parse_part_spec(value: Any) -> PartSpec | None:
    if value is None:
        return None
    shape, dtype = value["shape"], value["dtype"]
    if not isinstance(shape, list) or not all(isinstance(side, int) and side > 0 for side in shape):
        raise ValueError(f"invalid shape {shape!r}")
    if dtype not in _DTYPES or math.prod(shape) * np.dtype(dtype).itemsize > _MAX_PART_BYTES:
        raise ValueError(f"invalid part: {shape} {dtype!r}")
    return PartSpec(tuple(shape), dtype)
