"""The pictures of a page: found by the names that a log or a map gives them, and made small enough for one file."""

import base64
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from edgevpr.core.arrays import Image, Mask
from edgevpr.core.errors import EdgevprError, ImageError, UsageError
from edgevpr.core.text import progress
from edgevpr.core.types import Place
from edgevpr.frames.positions import GeoTag

if TYPE_CHECKING:
    from edgevpr.frames.level import Lens

_SIDES_PX = (480, 320, 240, 160, 112)  # of the small pictures: the largest with which all fit is taken
_SAMPLES = 12  # pictures that say how many bytes one takes
_CUT_PX = 512  # of a picture from an orthophoto, as the map was made of
_AS_TEXT, _MARGIN = 4 / 3, 1.1  # base64; what others may take more

_FRAME = re.compile(r"frame \d{6} t=(\d+\.\d+) s")  # as `VideoSource` names them

Key = tuple[str, str]  # which album, and the name of a picture in it


class Album:
    """Finds pictures by the names that the log gives them: in `recorded` (files of a recording by the names of their
    frames) or else as files in `folders`. The flight and the map have an album each, since their pictures often have
    equal names. Raises UsageError for a folder that does not exist."""

    def __init__(self, folders: Sequence[str | Path], recorded: Mapping[str, Path] = MappingProxyType({})) -> None:
        self._recorded = recorded
        self._kept: dict[str, bytes] = {}
        self._folders = [Path(folder).resolve() for folder in folders]
        self._tags: dict[Path, Mapping[Path, GeoTag]] = {}
        for folder in self._folders:
            if not folder.is_dir():
                raise UsageError(f"{folder}: there is no such folder: give one that holds pictures, or a film.")

    def __bool__(self) -> bool:
        """Return True if there is anywhere to look for pictures."""
        return bool(self._folders or self._recorded or self._kept)

    def keep(self, name: str, image: Image) -> None:
        """Keep a small copy of the picture `name`, uint8 (H, W[, 3]): no file has to be read for it any more."""
        from edgevpr.frames.images import small_jpeg

        self._kept[name] = small_jpeg(image, _SIDES_PX[0])

    def image(self, name: str | None) -> Image | None:
        """Return the picture `name`, uint8 (H, W[, 3]); None if there is none that can be read."""
        if name in self._kept:
            from edgevpr.frames.images import decoded

            return decoded(self._kept[name])
        found = self._found(name)
        return found and found[1]

    def _found(self, name: str | None) -> tuple[Path, Image] | None:
        if not name or not self:
            return None
        from edgevpr.frames.images import read_image  # a page without pictures needs no OpenCV

        # A log from somebody else may name any file of this machine: show only files in the folders.
        paths = [folder / Path(name).name for folder in self._folders]
        for path in [self._recorded[name], *paths] if name in self._recorded else paths:
            with suppress(ImageError, OSError, ValueError):  # no picture, or a name that no file can have
                if path.is_file():
                    return path, read_image(path)
        return None

    def picture(self, name: str | None) -> bytes | None:
        """Return the picture `name` as a small JPEG; None if there is none that can be read."""
        image = self.image(name)
        if image is None:
            return None
        from edgevpr.frames.images import small_jpeg

        return small_jpeg(image)

    def laid(self, place: Place, lens: "Lens | None") -> tuple[Image, Mask | None] | None:
        """Return the picture of a place as its pose lays it on the ground, levelled if the `lens` is known, and its
        mask, bool (H, W), False where it shows no ground (None: nowhere). None if there is no such picture."""
        found = self._found(place.source_image)
        if found is None:
            return None
        path, image = found
        self.keep(place.source_image, image)  # photographs take long to decode
        tag = self._tags_beside(path.parent).get(path)
        if lens is None or tag is None:
            return image, None
        from edgevpr.frames.level import levelled
        from edgevpr.frames.source import tagged

        level = levelled(tagged(image, path.name, 0.0, tag), None, lens, below=True)
        return level.image, level.mask

    def _tags_beside(self, folder: Path) -> Mapping[Path, GeoTag]:
        if folder not in self._tags:
            from edgevpr.frames.source import tags_of

            self._tags[folder] = {}
            with suppress(EdgevprError):
                self._tags[folder] = tags_of(folder)
        return self._tags[folder]


class CutAlbum(Album):
    """The pictures of a map that was cut from an orthophoto: they are cut again. Raises EdgevprError if it cannot be
    opened."""

    def __init__(self, orthophoto: str | Path, places: Iterable[Place]) -> None:
        from edgevpr.mapmaking.orthophoto import Orthophoto  # loads GDAL, or raises if it is missing
        from edgevpr.mapmaking.tiles import ground_of

        super().__init__([])
        self._places = {place.source_image: place for place in places if place.position and place.pose}
        at = [(place.position, place.pose) for place in self._places.values() if place.position and place.pose]
        points = [(position.lat_deg, position.lon_deg) for position, _ in at]
        self._orthophoto = Orthophoto(orthophoto, ground_of(points, max(pose.footprint_m for _, pose in at)))

    def __bool__(self) -> bool:
        """Return True: there is an orthophoto to cut from."""
        return True

    def image(self, name: str | None) -> Image | None:
        """Return the picture of the place `name`, uint8 (H, W, 3); None if the map has none."""
        place = self._places.get(name or "")
        laid = self.laid(place, None) if place else None
        return laid and laid[0]

    def laid(self, place: Place, lens: "Lens | None") -> tuple[Image, Mask | None] | None:
        """Return the picture of a place, and its mask, see `Album`."""
        if not (place.position and place.pose):
            return None
        with suppress(ImageError):
            return self._orthophoto.cut(place.position, place.pose.footprint_m, _CUT_PX)
        return None


class FilmAlbum(Album):
    """The pictures of a film, by the names of its frames; those of a recording first. Raises EdgevprError for a file
    that is no film, and for an unusable table of positions beside it."""

    def __init__(self, film: Path, recorded: Mapping[str, Path] = MappingProxyType({})) -> None:
        from edgevpr.frames.positions import find_track, read_track
        from edgevpr.frames.source import open_source

        super().__init__([], recorded)
        self._film, table = film, find_track(film)
        self._track = read_track(table) if table else None
        self._open = partial(open_source, str(film), live=False)
        self._source, self._passed = self._open(), ""
        self._tag_of: dict[Path, GeoTag] = {}
        self._tags[film] = self._tag_of

    def __bool__(self) -> bool:
        """Return True: there is a film."""
        return True

    def _found(self, name: str | None) -> tuple[Path, Image] | None:
        if (recorded := super()._found(name)) or not (named := _FRAME.fullmatch(name or "")):
            return recorded
        from edgevpr.frames.source import read_to_end

        if named[0] <= self._passed:  # names are in the order of the film, which is read forwards
            self._source.close()
            self._source, self._passed = self._open(), ""
        for frame in filter(None, read_to_end(self._source, lambda error: None)):
            self._passed = frame.name
            if frame.name >= named[0]:
                path = self._film / frame.name
                if self._track:
                    self._tag_of[path] = self._track.tag_at(float(named[1]))
                return (path, frame.image) if frame.name == name else None
        return None


def album_of(sources: Sequence[str | Path], recorded: Mapping[str, Path] = MappingProxyType({})) -> Album:
    """Return the album of the pictures in `sources`: folders, or one film. `recorded`: see `Album`. Raises EdgevprError
    for a source that cannot be used."""
    if len(sources) == 1 and Path(sources[0]).is_file():
        return FilmAlbum(Path(sources[0]), recorded)
    return Album(sources, recorded)


def album_of_map(sources: Sequence[str | Path], places: Sequence[Place]) -> Album:
    """Return the album of a map's pictures. `sources` are folders of pictures, or a film; of a map that was cut from an
    orthophoto, the orthophoto. Raises EdgevprError for one that cannot be used."""
    if sources and any(place.position and place.pose and place.pose.is_surveyed for place in places):
        return CutAlbum(sources[0], places)
    return album_of(sources)


def small_pictures(
    steps: Sequence[Sequence[Key]], albums: Mapping[str, Album], room_bytes: float
) -> tuple[dict[Key, str], str]:
    """Load the pictures of all steps as data: addresses, in `room_bytes` together: as large as they fit, and if they
    do not fit at all, those of every second, third, ... step. Returns them by their keys, and a sentence on what is
    left out ("": nothing)."""
    keys = list(dict.fromkeys(key for step in steps for key in step if albums[key[0]]))
    if not keys:
        return {}, ""
    from edgevpr.frames.images import at_most, small_webp

    spread = dict.fromkeys([*keys[:: max(1, len(keys) // _SAMPLES)], *keys])
    images = (albums[of].image(name) for of, name in spread)
    samples = list(islice((at_most(image, _SIDES_PX[0]) for image in images if image is not None), _SAMPLES))
    if not samples:
        return {}, ""
    for side_px in _SIDES_PX:
        each_bytes = _MARGIN * _AS_TEXT * sum(len(small_webp(image, side_px)) for image in samples) / len(samples)
        if each_bytes * len(keys) <= room_bytes:
            break
    every = max(1, -(-int(each_bytes * len(keys)) // max(1, int(room_bytes))))
    keys = list(dict.fromkeys(key for step in steps[::every] for key in step if albums[key[0]]))
    found: dict[Key, str] = {}
    left_bytes = room_bytes
    for of, name in progress(keys, len(keys), "pictures"):
        if (image := albums[of].image(name)) is not None:
            data = "data:image/webp;base64," + base64.b64encode(small_webp(image, side_px)).decode()
            left_bytes -= len(data)
            if left_bytes < 0:
                return found, "The last steps have no pictures: the page would be too large."
            found[of, name] = data
    left_out = f"Pictures are shown of one step in {every}: with more the page would be too large."
    return found, left_out if every > 1 else ""
