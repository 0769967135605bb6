"""The pictures of a page: looked up by their names in a log or a map, and scaled down to fit into one file."""

import re
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType

from edgevpr.core.arrays import Image, Mask
from edgevpr.core.errors import EdgevprError, ImageError, UsageError
from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.text import progress
from edgevpr.core.types import Place
from edgevpr.frames.images import decode_jpeg, encode_small_jpeg, encode_small_webp, read_image
from edgevpr.frames.level import Lens, level_image
from edgevpr.frames.positions import GeoTag, find_track, read_track
from edgevpr.frames.source import make_frame, open_source, read_tags, read_to_end

_SIDES_PX = (480, 320, 240, 160, 112)  # longest sides of a small picture: the largest that fits is used
_MIN_BYTES = 2500  # typical size of the data: URL of a picture with the smallest side
_MAX_HEADING_ERROR_DEG = 45.0  # maximum angle between the tops of a picture and of its place
_CUT_PX = 512  # side of a picture cut from an orthophoto, as in `map build`

_FRAME_NAME = re.compile(r"frame \d{6} t=(\d+\.\d+) s")  # the names that `VideoSource` gives

Key = tuple[str, str]  # name of an album, and name of a picture in it


@dataclass(frozen=True, slots=True)
class AlbumPicture:
    """A picture, uint8 (H, W[, 3]). `mask`: bool (H, W), False where it shows no ground (None: it shows ground
    everywhere). `tag`: function that reads its position and attitude (None: unknown)."""

    image: Image
    mask: Mask | None = None
    tag: Callable[[], GeoTag | None] | None = None


Finder = Callable[[str], AlbumPicture | None]  # returns the picture with a name; None if no such picture can be read


class Album:
    """Finds pictures by their names in a log or a map, trying `finders` in order. The flight and the map each have an
    album, because their pictures often have the same names."""

    def __init__(self, *finders: Finder) -> None:
        self._finders = finders
        self._copies: dict[str, bytes] = {}

    def __bool__(self) -> bool:
        """Return True if the album has any finder."""
        return bool(self._finders)

    def find_image(self, name: str) -> Image | None:
        """Return the picture `name`, uint8 (H, W[, 3]); None if no such picture can be read."""
        if name in self._copies:
            return decode_jpeg(self._copies[name])
        picture = self._find(name)
        return picture.image if picture else None

    def level_picture(self, place: Place, lens: Lens | None) -> AlbumPicture | None:
        """Return the picture of a place, levelled if the `lens` is known; None if the picture is not found."""
        picture = self._find(place.source_image)
        if picture is None:
            return None
        # Photographs are slow to decode, so a small copy replaces the second read of the file.
        self._copies[place.source_image] = encode_small_jpeg(picture.image, _SIDES_PX[0])
        tag = picture.tag() if lens and picture.tag else None
        if lens is None or tag is None:
            return picture
        level = level_image(make_frame(picture.image, place.source_image, 0.0, tag), None, lens, below=True)
        return AlbumPicture(level.image, level.mask)

    def align_picture(self, place: Place, lens: Lens | None) -> AlbumPicture | None:
        """Return the picture of a place in the orientation of its pose: either levelled and north-up (as in a map built
        with the `lens`) or as taken. None if it is not found or its heading contradicts both."""
        picture = self._find(place.source_image)
        tag = picture.tag() if picture and picture.tag else None
        if not tag or tag.heading_deg is None or not place.pose:
            return self.level_picture(place, lens)
        is_as_taken, is_level = (
            abs(wrap_deg(place.pose.up_deg - up_deg)) < _MAX_HEADING_ERROR_DEG
            for up_deg in (tag.heading_deg + (lens.up_deg if lens else 0.0), 0.0)
        )
        if lens and is_level:
            return self.level_picture(place, lens)
        return picture if is_as_taken else None

    def _find(self, name: str) -> AlbumPicture | None:
        return next((picture for finder in self._finders if (picture := finder(name))), None)


def _read_picture(
    path: Path, tag: Callable[[], GeoTag | None] | None = None, *, upright: bool = True
) -> AlbumPicture | None:
    with suppress(ImageError, OSError, ValueError):  # not a picture, or an invalid file name
        if path.is_file():
            return AlbumPicture(read_image(path, upright=upright), tag=tag)
    return None


def _find_in_folder(folder: Path, upright: bool, name: str) -> AlbumPicture | None:
    # A log from someone else may name any file on this machine, so show only files in the folder.
    path = folder / Path(name).name
    return _read_picture(path, lambda: _read_folder_tags(folder).get(path), upright=upright)


@cache
def _read_folder_tags(folder: Path) -> Mapping[Path, GeoTag]:
    with suppress(EdgevprError):
        return read_tags(folder)
    return {}


class _VideoFinder:
    """Finds the pictures of a video by the names of its frames. Raises EdgevprError for a file that is not a video or
    has an unusable table of positions next to it."""

    def __init__(self, video: Path) -> None:
        table = find_track(video)
        self._track = read_track(table) if table else None
        self._open = partial(open_source, str(video), live=False)
        self._source, self._last_name = self._open(), ""

    def __call__(self, name: str) -> AlbumPicture | None:
        match = _FRAME_NAME.fullmatch(name)
        if not match:
            return None
        if name <= self._last_name:  # names sort in the order of the video, which can only be read forwards
            self._source.close()
            self._source, self._last_name = self._open(), ""
        for frame in filter(None, read_to_end(self._source, lambda error: None)):
            self._last_name = frame.name
            if frame.name >= name:
                tag = partial(self._track.interpolate_tag, float(match[1])) if self._track else None
                return AlbumPicture(frame.image, tag=tag) if frame.name == name else None
        return None


def _open_orthophoto(source: str | Path, places: Sequence[Place]) -> Finder:
    """Return a finder that cuts the pictures of places out of an orthophoto again. Raises EdgevprError if the
    orthophoto cannot be opened."""
    from edgevpr.mapmaking.orthophoto import Orthophoto  # loads GDAL, or raises if it is missing

    cuts = {place.source_image: (place.position, place.pose) for place in places if place.position and place.pose}
    orthophoto = Orthophoto(source)

    def find(name: str) -> AlbumPicture | None:
        position, pose = cuts.get(name, (None, None))
        with suppress(ImageError):
            return AlbumPicture(*orthophoto.cut(position, pose.footprint_m, _CUT_PX)) if position and pose else None
        return None

    return find


def make_album(
    sources: Sequence[str | Path], recorded: Mapping[str, Path] = MappingProxyType({}), *, upright: bool = True
) -> Album:
    """Return the album of the pictures in `sources`, folders or one video. `recorded`: files of a recording by frame
    name, which are searched first. `upright`: see `read_image`. Raises EdgevprError for an unusable source."""
    finders: list[Finder] = []
    if recorded:
        finders.append(lambda name: _read_picture(recorded[name]) if name in recorded else None)
    if len(sources) == 1 and Path(sources[0]).is_file():
        return Album(*finders, _VideoFinder(Path(sources[0])))
    for folder in map(Path, sources):
        if not folder.is_dir():
            raise UsageError(f"{folder} does not exist: pass a folder of images, or a video.")
        finders.append(partial(_find_in_folder, folder.resolve(), upright))
    return Album(*finders)


def make_map_album(sources: Sequence[str | Path], places: Sequence[Place], *, upright: bool) -> Album:
    """Return the album of a map's pictures. `sources`: folders of pictures, a video, or the orthophoto from which the
    map was cut. `upright`: see `read_image`. Raises EdgevprError for a source that cannot be used."""
    if sources and any(place.position and place.pose and place.pose.is_surveyed for place in places):
        return Album(_open_orthophoto(sources[0], places))
    return make_album(sources, upright=upright)


def embed_pictures(
    steps: Sequence[Sequence[Key]], albums: Mapping[str, Album], budget_bytes: float
) -> tuple[dict[Key, str], str]:
    """Load the pictures of all steps as data: URLs of at most `budget_bytes` together. Each is as large as its part
    of the budget allows; if that is too little, only every second, third, ... step has pictures. Returns the URLs by
    key, and a sentence on what is left out ("": nothing)."""
    keys = list(dict.fromkeys(key for step in steps for key in step if albums[key[0]]))
    interval = max(1, -(-len(keys) * _MIN_BYTES // max(1, int(budget_bytes))))
    keys = list(dict.fromkeys(key for step in steps[::interval] for key in step if albums[key[0]]))
    pictures: dict[Key, str] = {}
    is_incomplete = interval > 1
    for number, (album, name) in enumerate(progress(keys, len(keys), "pictures")):
        image = albums[album].find_image(name)
        if image is None:
            continue
        for side_px in _SIDES_PX:
            url = f"data:image/webp;base64,{b64encode(encode_small_webp(image, side_px)).decode()}"
            if len(url) <= budget_bytes / (len(keys) - number):
                break
        if len(url) <= budget_bytes:
            pictures[album, name] = url
            budget_bytes -= len(url)
        else:
            is_incomplete = True
    return pictures, "Only some steps have pictures: the page would be too large with more." * is_incomplete
