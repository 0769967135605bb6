"""Map tiles and orthophotos at an address, for which the user has the right: https://.../{z}/{x}/{y}.png is fetched
here, and WMTS by GDAL. An address holds the user's key: messages, maps and names of files have only its host."""

import hashlib
import math
import os
import re
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPException
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen
from xml.etree import ElementTree

import cv2
import numpy as np

from edgevpr import __version__
from edgevpr.core.errors import SourceError, UsageError
from edgevpr.core.files import write_whole
from edgevpr.mapmaking.georaster import (
    CPLE_BaseError,
    MemoryFile,
    Pixel,
    RasterioError,
    rasterio,
    refusal,
    status_in,
)
from edgevpr.mapmaking.tiles import TILE_PX, Ground, Level, box_of, full_level

_WMTS = re.compile(r"(?i)^wmts:")
_ADDRESS = re.compile(r"(?i)(wmts:)?https?://")
_PARTS = ("{z}", "{x}", "{y}")
_AGENT = f"edgevpr/{__version__}"
_CONNECTIONS, _TIMEOUT_S = 2, 30
_MOST_BYTES = 10_000_000  # of a tile
_NO_TILE = (404, 410)
_TRIED = 3  # zooms, from the one that is wanted: servers have different highest ones
_WMTS_CACHE_BYTES, _WMTS_CACHE_S = 10_000_000_000, 31_536_000


def is_address(source: object) -> bool:
    """Return True for the address of tiles, and False for the name of a file or folder."""
    return bool(_ADDRESS.match(str(source)))


def host_of(address: str) -> str:
    """Return the host of an address, which may be said. Raises UsageError for an address that has none."""
    try:
        host = urlsplit(_WMTS.sub("", address)).hostname
    except ValueError:
        host = None
    if not host:
        raise UsageError("The address of the orthophoto has no host: write https://HOST/.../{z}/{x}/{y}.png.")
    return host


def _cache_folder(address: str) -> Path:
    """Return the folder for the tiles of an address, by its host and a hash."""
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    digest = hashlib.sha256(address.encode()).hexdigest()[:16]
    return Path(caches) / "edgevpr" / "tiles" / f"{host_of(address)}-{digest}"


class AddressTiles:
    """The tiles of an address, see `TileStore`. They are kept in a folder, and none is asked for twice; an empty file
    stands for one that the server does not have."""

    def __init__(self, address: str) -> None:
        self.name = self.short_name = host_of(address)
        braces = re.findall(r"\{[^{}]*\}", address)
        if sorted(set(braces)) != sorted(_PARTS):
            raise UsageError(
                f"The address at {self.name} must have {{z}}, {{x}} and {{y}} where zoom, column and row of a tile "
                "stand, and no other braces: https://HOST/.../{z}/{x}/{y}.png, or WMTS:https://..."
            )
        self._address, self._folder = address, _cache_folder(address)

    def levels(self, ground: Ground | None) -> dict[int, Level]:
        """See `TileStore`. Return the wanted zoom, or the next that the server has in the middle of the ground."""
        assert ground is not None  # an address needs an area
        box = box_of(ground)
        for zoom in range(ground.zoom, max(ground.zoom - _TRIED, -1), -1):
            at = full_level(zoom, box).some[0]
            if data := self.get(zoom, *at):
                tile = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
                if tile is None:
                    self._path(zoom, *at).unlink()
                    raise SourceError(f"{self.name} answers with what is no picture: check the address and its key.")
                zoom = max(zoom - round(math.log2(len(tile) / TILE_PX)), 0)  # a larger tile has finer pixels
                return {zoom: full_level(zoom, box)}
        raise SourceError(
            f"{self.name} has no tile of zoom {max(ground.zoom - _TRIED + 1, 0)} to {ground.zoom} in the middle of the "
            "area (HTTP 404): check address and area; a larger --footprint-m takes coarser tiles."
        )

    def _path(self, zoom: int, x: int, y: int) -> Path:
        return self._folder / str(zoom) / str(x % 2**zoom) / str(y)

    def missing(self, zoom: int, tiles: Iterable[Pixel]) -> list[Pixel]:
        """Return those of `tiles` that are yet to be fetched."""
        return [(x, y) for x, y in tiles if not self._path(zoom, x, y).exists()]

    def fetch(self, zoom: int, tiles: Iterable[Pixel]) -> Iterator[None]:
        """Fetch tiles, and yield once for each. Raises SourceError."""
        with ThreadPoolExecutor(_CONNECTIONS) as pool:
            for _ in pool.map(lambda at: self.get(zoom, *at), tiles):
                yield

    def get(self, zoom: int, x: int, y: int) -> bytes | None:
        """See `TileStore`. Raises SourceError if the server refuses or cannot be reached."""
        path = self._path(zoom, x, y)
        if not path.exists():
            data = self._fetched(zoom, x % 2**zoom, y)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, lambda unfinished: unfinished.write_bytes(data))
        return path.read_bytes() or None

    def _fetched(self, zoom: int, x: int, y: int) -> bytes:
        address = self._address
        for part, number in zip(_PARTS, (zoom, x, y), strict=True):
            address = address.replace(part, str(number))
        try:
            with urlopen(Request(address, headers={"User-Agent": _AGENT}), timeout=_TIMEOUT_S) as answer:
                return bytes(answer.read(_MOST_BYTES))
        except HTTPError as error:
            error.close()
            if error.code in _NO_TILE:
                return b""
            raise refusal(self.name, error.code) from None
        except (OSError, HTTPException, ValueError):  # their texts may hold the address
            raise refusal(self.name, None) from None

    def close(self) -> None:
        """Do nothing: no connection is held open between tiles."""


def described_wmts(address: str) -> str:
    """Return GDAL's description (XML) of the layer at `address`, WMTS:https://...[,layer=NAME], with what a good guest
    does. Raises SourceError."""
    host = host_of(address)
    try:
        with rasterio.Env(GDAL_HTTP_USERAGENT=_AGENT, GDAL_HTTP_TIMEOUT=_TIMEOUT_S), MemoryFile(ext=".xml") as file:
            rasterio.shutil.copy(address, file.name, driver="WMTS")
            root = ElementTree.fromstring(file.read())
    except (RasterioError, CPLE_BaseError) as error:
        raise refusal(host, status_in(error)) from None
    for name in ("Cache", "UnsafeSSL"):
        if (found := root.find(name)) is not None:
            root.remove(found)
    cache = ElementTree.SubElement(root, "Cache")
    kept = {"Path": _cache_folder(address), "MaxSize": _WMTS_CACHE_BYTES, "Expires": _WMTS_CACHE_S}
    asked = {"UserAgent": _AGENT, "Timeout": _TIMEOUT_S}
    for parent, values in ((cache, kept), (root, asked)):
        for name, value in values.items():
            ElementTree.SubElement(parent, name).text = str(value)
    return ElementTree.tostring(root, encoding="unicode")
