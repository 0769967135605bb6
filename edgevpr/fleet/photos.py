"""The photographs of a fleet, from many folders and tables, and those of one tile, brought to where it is mapped.

A table is a positions.csv whose column `file` has paths, relative to the table. A photograph is known by its content:
where it lies may change, and cameras begin their names anew on every card."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import distance_m
from edgevpr.core.text import decode_name
from edgevpr.frames.images import EXTENSIONS, is_image
from edgevpr.frames.positions import GeoTag, read_positions, write_positions
from edgevpr.frames.source import read_tags

_CHUNK_BYTES = 1 << 20
_HASH_DIGITS = 12
_MAX_WORD_CHARS = 40  # of a name: that of a file has 255 bytes
_SAME_M = 1.0  # between two positions of one photograph: written with fewer digits


Photos = Mapping[str, GeoTag]  # what is known of photographs, by their paths


@dataclass(frozen=True, slots=True)
class Gathered:
    """Photographs in a folder. `paths`: where each came from, by the name that it has there and in a map. `contents`: a
    text for each, of its content and its tag. `unusable`: a sentence about each other one, by its path."""

    paths: dict[str, str]
    contents: list[str]
    unusable: dict[str, str]


def list_photos(sources: Sequence[str]) -> Photos:
    """Return the photographs of folders and tables. One that is named twice counts once. Raises UsageError for a source
    that cannot be read, and for a photograph that has two positions."""
    found: dict[str, tuple[GeoTag, str]] = {}
    for source in sources:
        for path, tag in _of_source(source):
            before, of_source = found.setdefault(path, (tag, source))
            if not _agree(before, tag):
                raise UsageError(f"{path} has one position in {of_source} and another in {source}: give one of them.")
    return {path: tag for path, (tag, _) in found.items()}


def _agree(tag: GeoTag, other: GeoTag) -> bool:
    here, there = tag.position, other.position
    if here is None or there is None:
        return here is there
    return distance_m(here.lat_deg, here.lon_deg, there.lat_deg, there.lon_deg) <= _SAME_M


def _of_source(source: str) -> Iterator[tuple[str, GeoTag]]:
    path = Path(source)
    if path.is_dir():
        yield from ((str(image.absolute()), tag) for image, tag in read_tags(path).items())
    elif path.suffix.lower() == ".csv":
        folder = path.absolute().parent
        yield from ((str(folder / file), tag) for file, tag in read_positions(path).items())
    else:
        raise UsageError(f"--images {source} is no folder and no table of positions (.csv): give one of them.")


def content_in(name: str) -> str:
    """Return the part of a photograph's name that is a hash of its content."""
    return Path(name).stem.rpartition("_")[2]


def _name(path: str, sha256: str) -> str:
    """Return the name of a photograph in a map: its folder's, its own, so that names sort as the pictures were taken,
    and the hash of its content."""
    *folder, file = decode_name(path).rsplit("/", 2)[-2:]
    words = [*folder, Path(file).stem]
    return "_".join([*(word[-_MAX_WORD_CHARS:] for word in words), sha256[:_HASH_DIGITS]]) + Path(file).suffix


def gather(photos: Photos, folder: Path) -> Gathered:
    """Link photographs into a folder, with a positions.csv of them. Of those of one content the first counts."""
    found = Gathered({}, [], {})
    first: dict[str, str] = {}  # where a content was found first, by its hash
    for path, tag in photos.items():
        try:
            sha256 = _hash_file(path)
        except FileNotFoundError:
            found.unusable[path] = f"{path} is not there: correct the table, or bring it back"
            continue
        except OSError as error:
            found.unusable[path] = f"{path} cannot be read ({error.strerror})"
            continue
        same, name = first.setdefault(sha256, path), _name(path, sha256)
        if same != path:
            if not _agree(photos[same], tag):
                found.unusable[path] = f"{path} is the picture {same}, and has another position"
        elif not is_image(name):
            found.unusable[path] = f"{path} is no picture ({' '.join(EXTENSIONS)})"
        else:
            (folder / name).symlink_to(path)
            found.paths[name] = path
            found.contents.append(f"{sha256} {tag!r}")
    write_positions(folder / "positions.csv", {name: photos[path] for name, path in found.paths.items()})
    return found


def _hash_file(path: str) -> str:
    sha256 = hashlib.sha256()
    with open(path, "rb") as source:
        while chunk := source.read(_CHUNK_BYTES):
            sha256.update(chunk)
    return sha256.hexdigest()
