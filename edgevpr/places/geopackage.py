"""The GeoPackage standard (OGC 12-128r18, version 1.3) as map files use it: tables, points and times that QGIS, GDAL
and `sqlite3` can read."""

import struct
from datetime import datetime, timezone

APPLICATION_ID = 0x47504B47  # "GPKG"
USER_VERSION = 10300
WGS84 = 4326

_WGS84_WKT = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],UNIT["degree",0.0174532925199433,'
    'AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)

# The checksums (CRC-32 of zlib) precede the BLOBs because SQLite reads all of a large BLOB to find what follows it. A
# program that moves a place (QGIS) does not update the checksums, so a trigger deletes those of position and pose, and
# the recorded position (see `core.types.Pose`), from which a place that was moved must not be refined again.
SCHEMA = f"""
CREATE TABLE gpkg_spatial_ref_sys (
    srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
    organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
INSERT INTO gpkg_spatial_ref_sys VALUES
    ('Undefined Cartesian', -1, 'NONE', -1, 'undefined', NULL),
    ('Undefined geographic', 0, 'NONE', 0, 'undefined', NULL),
    ('WGS 84 geodetic', {WGS84}, 'EPSG', {WGS84}, '{_WGS84_WKT}', 'longitude and latitude in degrees');

CREATE TABLE gpkg_contents (
    table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
    description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
    min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
    srs_id INTEGER REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (
    table_name TEXT NOT NULL REFERENCES gpkg_contents(table_name), column_name TEXT NOT NULL,
    geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL REFERENCES gpkg_spatial_ref_sys(srs_id),
    z TINYINT NOT NULL, m TINYINT NOT NULL,
    CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name));

CREATE TABLE places (
    place_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom POINT, time DATETIME, alt_m DOUBLE, heading_deg DOUBLE,
    source_image TEXT NOT NULL, quality DOUBLE NOT NULL, memorability DOUBLE, staticity DOUBLE, entropy DOUBLE,
    is_low_quality BOOLEAN, up_deg DOUBLE, footprint_m DOUBLE, var_east_m2 DOUBLE, cov_east_north_m2 DOUBLE,
    var_north_m2 DOUBLE, is_surveyed BOOLEAN, recorded_lat_deg DOUBLE, recorded_lon_deg DOUBLE,
    geom_crc32 INTEGER, coarse_crc32 INTEGER, fine_crc32 INTEGER, pose_crc32 INTEGER, landmarks_crc32 INTEGER,
    coarse BLOB NOT NULL, fine BLOB, landmarks BLOB);
CREATE TRIGGER places_moved AFTER UPDATE OF geom ON places
BEGIN
    UPDATE places SET geom_crc32 = NULL, pose_crc32 = NULL, recorded_lat_deg = NULL, recorded_lon_deg = NULL
    WHERE place_id = NEW.place_id;
END;
CREATE TABLE edgevpr_map (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, key TEXT NOT NULL UNIQUE, value TEXT NOT NULL);
INSERT INTO gpkg_contents (table_name, data_type, identifier, description, srs_id) VALUES
    ('places', 'features', 'places', 'places seen by edgevpr, with their descriptors', {WGS84}),
    ('edgevpr_map', 'attributes', 'edgevpr_map', 'how the descriptors were made', NULL);
INSERT INTO gpkg_geometry_columns VALUES ('places', 'geom', 'POINT', {WGS84}, 0, 0);
"""

# Extends a layer's extent with each point, in the same transaction.
GROW_EXTENT = """
UPDATE gpkg_contents SET last_change = strftime('%Y-%m-%dT%H:%M:%fZ','now'),
    min_x = min(coalesce(min_x, :lon), :lon), max_x = max(coalesce(max_x, :lon), :lon),
    min_y = min(coalesce(min_y, :lat), :lat), max_y = max(coalesce(max_y, :lat), :lat)
WHERE table_name = :table
"""

# "GP", version 0, flags: little-endian, no envelope; srs_id; then well-known binary: little-endian, Point, x, y.
_POINT = struct.Struct("<2sBBiBIdd")
_POINT_HEADER = (b"GP", 0, 1, 1, 1)  # all fields except reference system and coordinates


def encode_point(lat_deg: float, lon_deg: float) -> bytes:
    """Encode a WGS-84 point, in degrees, as the bytes of a GeoPackage geometry."""
    return _POINT.pack(b"GP", 0, 1, WGS84, 1, 1, lon_deg, lat_deg)


def decode_point(blob: object) -> tuple[float, float]:
    """Decode a GeoPackage point (of `encode_point`, QGIS or GDAL) as (lat_deg, lon_deg). Raises ValueError with a short
    message for anything that is not a WGS-84 point on the Earth."""
    if not isinstance(blob, bytes) or len(blob) != _POINT.size:
        raise ValueError("its geometry is not a point")
    *header, srs_id, order, geometry_type, lon_deg, lat_deg = _POINT.unpack(blob)
    if (*header, order, geometry_type) != _POINT_HEADER:
        raise ValueError("its geometry is not a point")
    if srs_id != WGS84:
        raise ValueError(f"its position is in reference system {srs_id}, not in WGS 84")
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180):
        raise ValueError(f"latitude {lat_deg:g}, longitude {lon_deg:g} is not on the Earth")
    return lat_deg, lon_deg


def decode_point_or_none(geom: object) -> tuple[float, float] | None:
    """Decode a point like `decode_point`, but return None for anything that is not a WGS-84 point."""
    try:
        return decode_point(geom)
    except ValueError:
        return None


def format_utc(t_utc_s: float | None) -> str | None:
    """Format seconds since 1970 as a GeoPackage DATETIME, UTC with milliseconds; None if unknown or impossible."""
    if t_utc_s is None:
        return None
    try:
        moment = datetime.fromtimestamp(t_utc_s, timezone.utc)
    except (ValueError, OverflowError, OSError):
        return None
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def parse_utc(text: object) -> float | None:
    """Parse a time in the format of `format_utc`; return seconds since 1970, or None for anything else."""
    try:
        return datetime.fromisoformat(text.replace("Z", "+00:00")).timestamp() if isinstance(text, str) else None
    except (ValueError, OverflowError):
        return None
