"""The photographs of a fleet, from many folders and tables, and those of one tile, brought to where it is mapped.

A table is a positions.csv whose column `file` has paths, relative to the table, or addresses that fsspec opens, such as
s3://bucket/0001.jpg."""

import hashlib
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import fsspec

from edgevpr.core.errors import UsageError
from edgevpr.frames.positions import GeoTag, read_positions, write_positions
from edgevpr.frames.source import tags_of

_CHUNK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Photo:
    """A photograph at a path or an address, the `name` that a map has for it, which no other one has, and what is known
    of it (see `GeoTag`)."""

    uri: str
    name: str
    tag: GeoTag


def photos_of(sources: Sequence[str]) -> list[Photo]:
    """Return the photographs of folders and tables. Raises UsageError for a source that cannot be read."""
    found: dict[str, GeoTag] = {}
    for source in sources:
        for uri, tag in _of_source(source):
            found.setdefault(uri, tag)  # a folder that is named twice counts once
    return [Photo(uri, _name(uri), tag) for uri, tag in found.items()]


def _of_source(source: str) -> Iterator[tuple[str, GeoTag]]:
    path = Path(source)
    if path.is_dir():
        yield from ((str(image.absolute()), tag) for image, tag in tags_of(path).items())
    elif path.suffix.lower() == ".csv":
        folder = path.absolute().parent
        yield from ((file if "://" in file else str(folder / file), tag) for file, tag in read_positions(path).items())
    else:
        raise UsageError(f"--images {source} is no folder and no table of positions (.csv): give one of them.")


def _name(uri: str) -> str:
    """Return a name for a photograph: cameras begin theirs anew on every card, so it has that of its folder, too, and a
    hash of where both are. What else is mapped must not change it."""
    *folder, file = uri.rsplit("/", 2)[-2:]
    return "_".join([*folder, hashlib.sha256(uri.encode()).hexdigest()[:8], file])


def gathered(photos: Iterable[Photo], folder: Path) -> Iterator[tuple[Photo, str | None]]:
    """Bring photographs into a folder, with a positions.csv of them, and yield each with the hash of its content; None
    if it cannot be read."""
    tags = {}
    for photo in photos:
        sha256 = hashlib.sha256(repr(photo.tag).encode())
        target, is_here = folder / photo.name, "://" not in photo.uri
        try:
            with fsspec.open(photo.uri, "rb") as source, open(os.devnull if is_here else target, "wb") as copy:
                while chunk := source.read(_CHUNK_BYTES):
                    sha256.update(chunk)
                    copy.write(chunk)
        except (OSError, ValueError, ImportError):
            yield photo, None
            continue
        if is_here:
            target.symlink_to(photo.uri)
        tags[photo.name] = photo.tag
        yield photo, sha256.hexdigest()
    write_positions(folder / "positions.csv", tags)
