"""Opening and closing of a map file, and SQLite's errors turned into sentences for the user."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from edgevpr.errors import MapError
from edgevpr.places.geopackage import read_point


def connect(path: Path, mode: str) -> sqlite3.Connection:
    """Open a map file; `mode` is SQLite's: ro, rw or rwc. Raises sqlite3.Error."""
    # Autocommit: transactions are begun by hand, so that nothing is ever half committed.
    db = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}", uri=True, isolation_level=None, timeout=5, check_same_thread=False
    )
    # The triggers of the spatial index (OGC 12-128r18, annex F.3) call these functions, which SQLite itself lacks. QGIS
    # or GDAL may have added such an index.
    db.create_function("ST_IsEmpty", 1, lambda geom: geom is None)
    for name, axis in {"ST_MinX": 1, "ST_MaxX": 1, "ST_MinY": 0, "ST_MaxY": 0}.items():
        db.create_function(name, 1, lambda geom, axis=axis: read_point(geom)[axis] if geom else None)
    return db


def start_log(db: sqlite3.Connection) -> None:
    # A write-ahead log, synced at every commit: a confirmed place survives a power loss.
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("PRAGMA synchronous = FULL")


def settle(db: sqlite3.Connection) -> None:
    """Fold the write-ahead log into the file. The log stays where another program has the map open: no harm."""
    try:
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        db.execute("PRAGMA journal_mode = DELETE")
    except sqlite3.Error:
        pass


def settle_left_log(path: Path) -> None:
    """Recover a map that was not closed (its log is beside it), where the file and its folder may be written."""
    if path.with_name(path.name + "-wal").exists():
        try:
            db = connect(path, "rw")
            settle(db)
            db.close()
        except sqlite3.Error:
            pass  # a read-only medium: SQLite reads map and log as they are, or says what is wrong


@contextmanager
def sentences(path: Path) -> Iterator[None]:
    """Turn an error of SQLite into a MapError that says what the user can do."""
    try:
        yield
    except sqlite3.Error as error:
        said = str(error)
        if "full" in said:
            advice = "the disk is full: make room; every place confirmed so far is kept"
        elif "not a database" in said:
            advice = "this is not a place map: give a .gpkg file made by `edgevpr map build`"
        elif "no such module" in said:
            advice = f"the SQLite of this Python lacks what learning needs ({said}): use the system's own Python"
        elif "malformed" in said or "no such" in said:
            advice = f"the file is damaged or no place map ({said}): restore a copy or build it again"
        elif "readonly" in said:
            advice = "it may not be written: check its permissions and those of its folder"
        elif "unable to open" in said:
            advice = "it cannot be opened: check the path, and the permissions of the file and its folder"
        elif "locked" in said:
            advice = "another program is writing to it: close that program and try again"
        else:
            advice = f"SQLite says: {said}: check the disk and its free space"
        raise MapError(f"{path}: {advice}.") from error
