"""The table edgevpr_map of a map file: the format of the file, and the technique that made its descriptors."""

import json
import sqlite3
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from edgevpr import __version__
from edgevpr.contract import PartSpec, TechniqueSpec
from edgevpr.errors import MapError
from edgevpr.places import geopackage

FORMAT_VERSION = 1


def write_spec(db: sqlite3.Connection, spec: TechniqueSpec) -> None:
    """Write the table, which must be there and empty. Raises sqlite3.Error."""
    described = {
        "format_version": FORMAT_VERSION,
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


def read_spec(path: Path, db: sqlite3.Connection) -> TechniqueSpec:
    """Read the specification of the technique that made the map file `path`, open as `db`.

    Raises MapError for a file that is no place map, is damaged, or has a newer format.
    """
    (application_id,) = db.execute("PRAGMA application_id").fetchone()
    tables = {name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if application_id != geopackage.APPLICATION_ID or "edgevpr_map" not in tables:
        raise MapError(f"{path}: this is not a place map: give a .gpkg file made by `edgevpr map build`.")
    try:
        stored = {key: json.loads(value) for key, value in db.execute("SELECT key, value FROM edgevpr_map")}
        if stored["format_version"] > FORMAT_VERSION:
            raise MapError(
                f"{path} comes from a newer edgevpr (map format {stored['format_version']}, this one reads up to "
                f"{FORMAT_VERSION}): update edgevpr."
            )
        return TechniqueSpec(
            name=stored["technique"],
            parameters=stored["parameters"],
            coarse=_part_spec(stored["coarse"]),
            fine=_part_spec(stored["fine"]),
            model_sha256=stored["model_sha256"],
            packed=_part_spec(stored["packed"]),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise MapError(
            f"{path}: its table edgevpr_map is damaged ({error!r}): restore a copy or build the map again."
        ) from error


def write_mask(db: sqlite3.Connection, sha256: str | None) -> None:
    """Record which overlay mask (None: none) the places of a map are made with. Raises sqlite3.Error."""
    db.execute("INSERT OR REPLACE INTO edgevpr_map (key, value) VALUES ('mask_sha256', ?)", (json.dumps(sha256),))


def read_mask(db: sqlite3.Connection) -> str | None:
    """Read which overlay mask the places of a map were made with; None for none, or a map that does not say."""
    row = db.execute("SELECT value FROM edgevpr_map WHERE key = 'mask_sha256'").fetchone()
    return json.loads(row[0]) if row else None


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


def _part_spec(stored: dict | None) -> PartSpec | None:
    return PartSpec(tuple(stored["shape"]), stored["dtype"]) if stored else None
