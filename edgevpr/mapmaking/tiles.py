"""Map tiles (zoom/x/y: squares of the Web Mercator projection) of a folder, described for GDAL's driver WMS, which
joins them."""

from pathlib import Path
from typing import TypeGuard
from xml.sax.saxutils import escape

import cv2
import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.core.errors import SourceError
from edgevpr.mapmaking.georaster import HALF_WORLD_M

_TILE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
_TMS_RESOURCE = "tilemapresource.xml"  # by OSGeo's Tile Map Service, whose y counts from the south
_MAX_JOINS = 50
_MAX_DIFFERENCE_RATIO = 0.5  # ratio of the differences along two edges; of tiles that do not join it is near 1


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
    across, down, side_px, tile_m = right + 1 - left, bottom + 1 - top, len(first), 2 * HALF_WORLD_M / 2**zoom
    # A tile that is not there is transparent, and coarser zooms are not asked for.
    return f"""<GDAL_WMS>
<Service name="TMS"><ServerUrl>file://{escape(str(links))}/${{x}}/${{y}}</ServerUrl></Service>
<DataWindow>
<UpperLeftX>{left * tile_m - HALF_WORLD_M!r}</UpperLeftX>
<UpperLeftY>{HALF_WORLD_M - top * tile_m!r}</UpperLeftY>
<LowerRightX>{(left + across) * tile_m - HALF_WORLD_M!r}</LowerRightX>
<LowerRightY>{HALF_WORLD_M - (top + down) * tile_m!r}</LowerRightY>
<TileLevel>{zoom}</TileLevel><TileX>{left}</TileX><TileY>{top}</TileY><YOrigin>top</YOrigin>
<SizeX>{across * side_px}</SizeX><SizeY>{down * side_px}</SizeY>
</DataWindow>
<Projection>EPSG:3857</Projection><BandsCount>4</BandsCount><OverviewCount>0</OverviewCount>
<BlockSizeX>{side_px}</BlockSizeX><BlockSizeY>{side_px}</BlockSizeY>
<ZeroBlockHttpCodes>404</ZeroBlockHttpCodes>
</GDAL_WMS>"""


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


def _is_square(tile: object) -> TypeGuard[Image]:
    return isinstance(tile, np.ndarray) and tile.shape[0] == tile.shape[1] and not tile.shape[0] & tile.shape[0] - 1
