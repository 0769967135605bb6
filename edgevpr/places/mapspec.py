"""The table edgevpr_map of a map file: the format of the file, and the technique that made its descriptors."""

import json
import math
import sqlite3
import uuid
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr import __version__
from edgevpr.core.contract import PartSpec, TechniqueSpec
from edgevpr.core.errors import MapError
from edgevpr.places import geopackage, rows
from edgevpr.places.sqlite import is_of_one_row

FORMAT_VERSION = 4  # 1 had no checksums and no map_id, 2 no salience, 3 no pose and no landmarks
_WITH_CHECKSUMS, _WITH_SALIENCE, _WITH_POSE = 2, 3, 4
_DTYPES = ("|i1", "|u1", "<i1", "<u1", *(f"<{kind}{size}" for kind in "iu" for size in "248"), "<f2", "<f4", "<f8")
_MOST_PART_BYTES = 64_000_000
BESIDE = MASK, CALIBRATION = ("mask_sha256", "calibration")
_MOST_STORED = 1000  # rows of the table, and characters that a message shows of a damaged one

Stored = dict[str, Any]


def write_spec(db: sqlite3.Connection, spec: TechniqueSpec) -> None:
    """Write the table, which must be there and empty. Raises sqlite3.Error."""
    described = {
        "format_version": FORMAT_VERSION,
        "map_id": uuid.uuid4().hex,
        "made_by": f"edgevpr {__version__}",
        "technique": spec.name,
        "parameters": spec.parameters,
        "model_sha256": spec.model_sha256,
        "coarse": asdict(spec.coarse),
        "fine": asdict(spec.fine) if spec.fine else None,
        "packed": asdict(spec.packed) if spec.packed else None,
    }
    db.executemany(
        "INSERT INTO edgevpr_map (key, value) VALUES (?, ?)",
        [(key, json.dumps(value)) for key, value in described.items()],
    )


def stored(path: Path, db: sqlite3.Connection) -> Stored:
    """Read the table of the map file `path`, open as `db`: what it says of the map, by key.

    Raises MapError for a file that is no place map or has a newer format, and sqlite3.Error.
    """
    (application_id,) = db.execute("PRAGMA application_id").fetchone()
    # A view or a virtual table has no page of its own in the file; a query of one need not end.
    tables = {name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0")}
    if application_id != geopackage.APPLICATION_ID or not {"edgevpr_map", "places"} <= tables:
        raise MapError(f"{path}: this is not a place map: give a .gpkg file made by `edgevpr map build`.")
    try:
        # What is kept beside the places is read when it is asked for: a map is of use without it.
        rows = db.execute("SELECT key, value FROM edgevpr_map WHERE key NOT IN (?, ?)", BESIDE).fetchmany(_MOST_STORED)
        found = {key: json.loads(value) for key, value in rows}
        version = found["format_version"]
        if not isinstance(version, int) or version < 1:
            raise ValueError(f"format version {version}")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise _damaged(path, error) from error
    if version > FORMAT_VERSION:
        raise MapError(
            f"{path} comes from a newer edgevpr (map format {version}, this one reads up to {FORMAT_VERSION}): update "
            "edgevpr."
        )
    return found


def has_checksums(found: Stored) -> bool:
    """Tell whether the places of a map have columns of checksums."""
    return found["format_version"] >= _WITH_CHECKSUMS


def has_salience(found: Stored) -> bool:
    """Tell whether the places of a map have columns of salience."""
    return found["format_version"] >= _WITH_SALIENCE


def has_pose(found: Stored) -> bool:
    """Tell whether the places of a map have columns of their pose and landmarks."""
    return found["format_version"] >= _WITH_POSE


def spec_of(path: Path, found: Stored) -> TechniqueSpec:
    """Return the specification of the technique that made the map. Raises MapError for one that makes no sense."""
    try:
        coarse = _part_spec(found["coarse"])
        if coarse is None:
            raise ValueError("no coarse part")
        return TechniqueSpec(
            name=_word(found["technique"]),
            parameters=_parameters(found["parameters"]),
            coarse=coarse,
            fine=_part_spec(found["fine"]),
            model_sha256=None if found["model_sha256"] is None else _word(found["model_sha256"]),
            packed=_part_spec(found["packed"]),
        )
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise _damaged(path, error) from error


def require_layer(path: Path, db: sqlite3.Connection, found: Stored) -> None:
    """Raise MapError where the table of places has not the columns and the kind of positions that every map has.

    `found` is what the map says of itself. Raises sqlite3.Error.
    """
    wanted = set(rows.COLUMNS)
    wanted.update(rows.CHECKSUMS.split(", ") if has_checksums(found) else ())
    wanted.update(rows.SALIENCE.split(", ") if has_salience(found) else ())
    if has_pose(found):
        wanted.update(f"{rows.POSE}, {rows.NEW_CHECKSUMS}, {rows.LANDMARKS}".split(", "))
    # A generated column is hidden: it stands in no row, and may be as large as its expression says.
    there = {name: (hidden, kind, key) for _, name, kind, _, _, key, hidden in db.execute("PRAGMA table_xinfo(places)")}
    wrong = sorted(name for name in wanted if there.get(name, (True,))[0])
    if wrong or there["place_id"][1:] != ("INTEGER", 1):
        raise MapError(
            f"{path}: its table of places has not the columns of a map ({', '.join(wrong) or 'place_id'}): restore a "
            "copy or build the map again."
        )
    layer = db.execute(
        "SELECT column_name, upper(geometry_type_name), srs_id FROM gpkg_geometry_columns WHERE table_name = 'places'"
    ).fetchone()
    if layer != ("geom", "POINT", geopackage.WGS84):
        raise MapError(
            f"{path}: its positions are not points in WGS 84 ({layer}): give the map that edgevpr has made, or export "
            "the layer again in EPSG:4326."
        )


def write_text(db: sqlite3.Connection, key: str, text: str | None) -> None:
    """Record something beside the places, such as which overlay mask they are made with. Raises sqlite3.Error."""
    db.execute("INSERT OR REPLACE INTO edgevpr_map (key, value) VALUES (?, ?)", (key, json.dumps(text)))


def read_text(db: sqlite3.Connection, key: str) -> str | None:
    """Read what was recorded; None for nothing, a map that does not say, or a row that cannot be read. Raises
    sqlite3.Error."""
    try:
        row = db.execute("SELECT value FROM edgevpr_map WHERE key = ?", (key,)).fetchone()
        text = json.loads(row[0]) if row else None
    except (ValueError, TypeError, RecursionError):
        return None
    except sqlite3.Error as error:
        if is_of_one_row(error):
            return None
        raise
    return text if isinstance(text, str) else None


def differences(theirs: TechniqueSpec, ours: TechniqueSpec) -> list[str]:
    """List, in words, in what the technique of a map differs from ours."""
    return [f"{what} is {there}, not {here}" for what, there, here in _compared(theirs, ours) if there != here]


def _compared(theirs: TechniqueSpec, ours: TechniqueSpec) -> Iterator[tuple[str, object, object]]:
    yield "technique", theirs.name, ours.name
    if theirs.name == ours.name:
        for key in sorted(theirs.parameters.keys() | ours.parameters.keys()):
            yield key, theirs.parameters.get(key), ours.parameters.get(key)
        yield "model sha256", theirs.model_sha256, ours.model_sha256
        yield "form of the coarse part", theirs.coarse, ours.coarse
        yield "form of the fine part", theirs.fine, ours.fine


def _damaged(path: Path, error: Exception) -> MapError:
    said = repr(error)[:_MOST_STORED]
    return MapError(f"{path}: its table edgevpr_map is damaged ({said}): restore a copy or build the map again.")


def _word(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no text")
    return value


def _parameters(value: object) -> dict[str, int | float | str]:
    if not isinstance(value, dict):
        raise TypeError("the parameters are no object")
    for each in value.values():
        if not isinstance(each, (int, float, str)) or (isinstance(each, float) and not math.isfinite(each)):
            raise TypeError(f"{each!r} is no value of a parameter")
    return value


def _part_spec(value: object) -> PartSpec | None:
    if value is None:
        return None
    shape, dtype = value["shape"], value["dtype"]
    if not isinstance(shape, list) or not all(isinstance(each, int) and each > 0 for each in shape):
        raise ValueError(f"the shape {shape!r}")
    if dtype not in _DTYPES:
        raise ValueError(f"the dtype {dtype!r}")
    if math.prod(shape) * np.dtype(dtype).itemsize > _MOST_PART_BYTES:
        raise ValueError(f"a part of {shape} {dtype}")
    return PartSpec(tuple(shape), dtype)
