"""Map tiles (zoom/x/y: squares of the Web Mercator projection) of a folder or an address, described for GDAL's driver
WMS, which fetches, keeps and joins them.

An address holds the user's key: messages, maps and names of files have only its host."""

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import NamedTuple, TypeGuard
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen
from xml.sax.saxutils import escape

import cv2
import numpy as np

from edgevpr import __version__
from edgevpr.core.arrays import Image, LatLon
from edgevpr.core.errors import SourceError, UsageError
from edgevpr.core.geodesy import EARTH_RADIUS_M, Extent, compute_extent
from edgevpr.mapmaking.georaster import HALF_WORLD_M

TILE_PX = 256  # the usual side
_FOOTPRINT_PX = 640  # of a footprint, in tiles as fine as a technique can use
_MAX_ZOOM = 24
_MAX_LAT_DEG = 85.0
_TILE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
_TMS_RESOURCE = "tilemapresource.xml"  # by OSGeo's Tile Map Service, whose y counts from the south
_MAX_JOINS = 50
_MAX_DIFFERENCE_RATIO = 0.5  # ratio of the differences along two edges; of tiles that do not join it is near 1
_PLACEHOLDERS = ("{z}", "{x}", "{y}")
_MAX_CONNECTIONS = 2
_TIMEOUT_S = 30
_MAX_TILE_BYTES = 10_000_000
_ABSENT_STATUSES = (204, 404, 410)  # HTTP status
_MAX_ZOOM_TRIES = 3  # from the one that is wanted: servers have different highest ones


@dataclass(frozen=True, slots=True)
class Ground:
    """Ground to cut pictures from. `extent_deg`: south, west, north, east, with a margin; east is above 180 if it
    crosses the antimeridian. `footprint_m`: ground along a side of a picture."""

    extent_deg: Extent
    footprint_m: float

    @property
    def zoom(self) -> int:
        """The zoom at which tiles of 256 pixels are as fine as a technique can use."""
        south, _, north, _ = self.extent_deg
        world_px = 2 * HALF_WORLD_M * math.cos(math.radians((south + north) / 2)) / self.footprint_m * _FOOTPRINT_PX
        return min(max(math.ceil(math.log2(world_px / TILE_PX)), 0), _MAX_ZOOM)


class _Window(NamedTuple):
    """Tiles of one zoom: the least x and y, and the greatest plus 1."""

    zoom: int
    left: int
    top: int
    right: int
    bottom: int


def surround(points: Sequence[LatLon], footprint_m: float) -> Ground:
    """Return the ground around `points` (lat, lon), with a margin that suits a path and the pictures along it."""
    footprint_m = min(max(1.0, footprint_m), HALF_WORLD_M)  # what is wrong with another, `make_lattice` says
    south, west, north, east = compute_extent(points)
    north_deg = math.degrees(2 * footprint_m / EARTH_RADIUS_M)
    east_deg = north_deg / math.cos(math.radians(min(max(abs(south), abs(north)), _MAX_LAT_DEG)))
    return Ground((south - north_deg, west - east_deg, north + north_deg, east + east_deg), footprint_m)


def is_address(source: object) -> bool:
    """Return True for the address of tiles, and False for the name of a file or folder."""
    return bool(re.match(r"(?i)https?://", str(source)))


def parse_host(address: str) -> str:
    """Return the host of an address, which may be shown. Raises UsageError for an address that has none."""
    try:
        host = urlsplit(address).hostname
    except ValueError:
        host = None
    if not host:
        raise UsageError("The address of the orthophoto has no host: write https://HOST/.../{z}/{x}/{y}.png.")
    return host


def describe_folder(folder: Path, links: Path) -> str:
    """Return what GDAL opens as the tiles of the highest zoom in a folder. It reads them by links in the folder
    `links`, which are named from the north. Raises SourceError if there are none, or if their rows count otherwise than
    is said."""
    tiles = {
        tuple(map(int, (*path.parts[-3:-1], path.stem))): path
        for path in folder.glob("*/*/*")
        if path.suffix.lower() in _TILE_SUFFIXES and all(map(str.isdecimal, (*path.parts[-3:-1], path.stem)))
    }
    zoom = max((zoom for zoom, _, _ in tiles), default=0)
    tiles = {tile: path for tile, path in tiles.items() if tile[0] == zoom}
    first = next(filter(_is_square, (cv2.imread(str(path)) for path in tiles.values())), None)
    if first is None:
        raise SourceError(
            f"{folder} holds no map tiles (PNG, JPEG or WebP, square, of 256 or 512 pixels): give another, or the "
            "folder above the zooms (z/x/y.png)."
        )
    if (folder / _TMS_RESOURCE).exists():
        tiles = {(zoom, x, 2**zoom - 1 - y): path for (_, x, y), path in tiles.items()}
    _require_joining_rows(folder, tiles)
    for (_, x, y), path in tiles.items():
        (links / str(x)).mkdir(exist_ok=True)
        (links / str(x) / str(y)).symlink_to(path.absolute())
    (_, left, top), (_, right, bottom) = (edge(list(tiles), axis=0).tolist() for edge in (np.min, np.max))
    return _format_gdal_xml(f"file://{links}/{{x}}/{{y}}", _Window(zoom, left, top, right + 1, bottom + 1), len(first))


def _require_joining_rows(folder: Path, tiles: dict[tuple[int, ...], Path]) -> None:
    """Raise SourceError if the rows of tiles, named from the north, join clearly better the other way round."""
    pairs = [(path, tiles[zoom, x, y + 1]) for (zoom, x, y), path in tiles.items() if (zoom, x, y + 1) in tiles]
    named, other = [0.0], [0.0]
    for paths in pairs[:: max(1, len(pairs) // _MAX_JOINS)]:
        upper, lower = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths)
        if _is_square(upper) and _is_square(lower) and upper.shape == lower.shape:
            named.append(float(cv2.absdiff(upper[-1], lower[0]).mean()))
            other.append(float(cv2.absdiff(lower[-1], upper[0]).mean()))
    if sum(other) >= _MAX_DIFFERENCE_RATIO * sum(named):
        return
    if (folder / _TMS_RESOURCE).exists():
        advice = f"from the north, and {_TMS_RESOURCE} says from the south: remove it if the tiles were written so"
    else:
        advice = (
            f"from the south (TMS): write them with `gdal2tiles --xyz`, or put their {_TMS_RESOURCE} beside the zooms"
        )
    raise SourceError(f"{folder}: the rows of its tiles join only if y counts {advice}.")


def describe_address(address: str, ground: Ground) -> str:
    """Return what GDAL opens as the tiles of an address that touch `ground`, of the zoom that suits it, or of the next
    coarser that the server has in the middle. They are kept in a folder that is named by the host, and none is
    fetched twice. Raises UsageError for an address that has other placeholders, and SourceError if the server refuses
    or cannot be reached."""
    host = parse_host(address)
    if sorted(re.findall(r"\{[^{}]*\}", address)) != sorted(_PLACEHOLDERS):
        raise UsageError(
            f"The address at {host} must have {{z}}, {{x}} and {{y}} where zoom, column and row of a tile stand, and "
            "no other braces: https://HOST/.../{z}/{x}/{y}.png."
        )
    for zoom in range(ground.zoom, max(ground.zoom - _MAX_ZOOM_TRIES, -1), -1):
        window = _find_window(ground, zoom)
        tile = _fetch_tile(address, zoom, (window.left + window.right) // 2, (window.top + window.bottom) // 2)
        if tile is not None:
            # A larger tile has finer pixels.
            window = _find_window(ground, max(zoom - round(math.log2(len(tile) / TILE_PX)), 0))
            caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
            return _format_gdal_xml(address, window, len(tile), Path(caches) / "edgevpr" / "tiles" / host)
    raise SourceError(
        f"{host} has no tile of zoom {max(ground.zoom - _MAX_ZOOM_TRIES + 1, 0)} to {ground.zoom} in the middle of the "
        "area (HTTP 404): check address and area; a larger --footprint-m takes coarser tiles."
    )


def _find_window(ground: Ground, zoom: int) -> _Window:
    """Return the tiles of a zoom that touch the ground."""
    south, west, north, east = ground.extent_deg
    top, bottom = (
        0.5 - math.asinh(math.tan(math.radians(min(max(lat_deg, -_MAX_LAT_DEG), _MAX_LAT_DEG)))) / (2 * math.pi)
        for lat_deg in (north, south)
    )
    corners = west / 360 + 0.5, top, east / 360 + 0.5, bottom
    left, first, right, last = (math.floor(each * 2**zoom) for each in corners)
    return _Window(zoom, left, first, right + 1, last + 1)


def _fetch_tile(address: str, zoom: int, x: int, y: int) -> Image | None:
    """Fetch one tile; None if the server has none there. Raises SourceError."""
    host = parse_host(address)
    for placeholder, number in zip(_PLACEHOLDERS, (zoom, x % 2**zoom, y), strict=True):
        address = address.replace(placeholder, str(number))
    # The texts of these errors may hold the address, and so must not be chained.
    try:
        request = Request(address, headers={"User-Agent": f"edgevpr/{__version__}"})
        with urlopen(request, timeout=_TIMEOUT_S) as answer:
            data = answer.read(_MAX_TILE_BYTES)
    except HTTPError as error:
        error.close()
        if error.code in _ABSENT_STATUSES:
            return None
        raise SourceError(
            f"{host} gives no tile (HTTP {error.code}): check the key in the address (401, 403) and your right to "
            "fetch its tiles, or wait (429, 5xx), and run this again."
        ) from None
    except (OSError, HTTPException, ValueError):
        raise SourceError(f"{host} cannot be reached: check the address and the network, and run this again.") from None
    tile = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if not _is_square(tile):
        raise SourceError(f"{host} answers with what is no tile: check the address and its key.")
    return np.asarray(tile, np.uint8)


def _is_square(tile: object) -> TypeGuard[Image]:
    return isinstance(tile, np.ndarray) and tile.shape[0] == tile.shape[1] and not tile.shape[0] & tile.shape[0] - 1


def _format_gdal_xml(address: str, window: _Window, side_px: int, cache: Path | None = None) -> str:
    """Return the XML by which GDAL opens the tiles of a window; `cache` is the folder where it keeps them (None: they
    are files). A tile that is not there is transparent, and coarser zooms are not asked for."""
    tile_m = 2 * HALF_WORLD_M / 2**window.zoom
    kept = f"<Path>{escape(str(cache))}</Path><Expires>2147483647</Expires><CleanTimeout>0</CleanTimeout>"
    return f"""<GDAL_WMS>
<Service name="TMS"><ServerUrl>{escape(address.replace("{", "${"))}</ServerUrl></Service>
<DataWindow>
<UpperLeftX>{window.left * tile_m - HALF_WORLD_M!r}</UpperLeftX>
<UpperLeftY>{HALF_WORLD_M - window.top * tile_m!r}</UpperLeftY>
<LowerRightX>{window.right * tile_m - HALF_WORLD_M!r}</LowerRightX>
<LowerRightY>{HALF_WORLD_M - window.bottom * tile_m!r}</LowerRightY>
<TileLevel>{window.zoom}</TileLevel><TileX>{window.left}</TileX><TileY>{window.top}</TileY><YOrigin>top</YOrigin>
<SizeX>{(window.right - window.left) * side_px}</SizeX><SizeY>{(window.bottom - window.top) * side_px}</SizeY>
</DataWindow>
<Projection>EPSG:3857</Projection><BandsCount>4</BandsCount><OverviewCount>0</OverviewCount>
<BlockSizeX>{side_px}</BlockSizeX><BlockSizeY>{side_px}</BlockSizeY>
<ZeroBlockHttpCodes>{",".join(map(str, _ABSENT_STATUSES))}</ZeroBlockHttpCodes>
<MaxConnections>{_MAX_CONNECTIONS}</MaxConnections><Timeout>{_TIMEOUT_S}</Timeout>
<UserAgent>edgevpr/{__version__}</UserAgent>{f"<Cache>{kept}</Cache>" if cache else ""}
</GDAL_WMS>"""
