"""The identity of a map: the same for every copy of its file, another as soon as one place is another.

A hash of the file would read all of it at every start, which takes a small board seconds. The checksums of the places
stand before their descriptors, so reading them is quick, and they say as much.
"""

import hashlib
from dataclasses import dataclass

from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.rows import VALUES
from edgevpr.places.sqlite import sentences


@dataclass(frozen=True, slots=True)
class MapIdentity:
    """`map_id` was drawn when the map was made (None: by an early edgevpr). `sha256` is of all `places` (positions,
    poses, names of pictures, checksums of what is larger, by a map that has them) and of all else the map says of
    itself, such as its calibration."""

    map_id: str | None
    places: int
    sha256: str


def identity_of(place_map: PlaceMap) -> MapIdentity:
    """Return the identity of an open map, as it is now. Raises MapError where it cannot be read."""
    digest, places = hashlib.sha256(), 0
    with sentences(place_map.path):
        for row in place_map.db.execute("SELECT key, value FROM edgevpr_map ORDER BY key"):
            digest.update(repr(row).encode("utf-8", "backslashreplace"))
    columns = f"{VALUES}, {place_map.salience}, {place_map.pose}, {place_map.checksums}"
    for place in place_map.scan(columns):
        digest.update(repr(place).encode("utf-8", "backslashreplace"))
        places += 1
    return MapIdentity(place_map.map_id, places, digest.hexdigest())
