"""Describes a folder of map tiles (zoom/x/y, squares of the Web Mercator projection) for GDAL's WMS driver, which joins
them into one raster."""

from pathlib import Path
from typing import TypeGuard
from xml.sax.saxutils import escape

import cv2
import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.core.errors import SourceError
from edgevpr.mapmaking.georaster import HALF_WORLD_M

_TILE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
_TMS_RESOURCE = "tilemapresource.xml"  # marks OSGeo's Tile Map Service, whose rows are numbered from the south
_MAX_JOINS = 50
_MAX_DIFFERENCE_RATIO = 0.5  # of the differences along tile edges, opposite to expected order; near 1 if neither joins


def describe_folder(folder: Path, links: Path) -> str:
    """Return the GDAL data set description for the tiles of the highest zoom level in `folder`. GDAL reads them through
    symlinks in `links`, whose rows are numbered from the north (XYZ). Raises SourceError if there are no tiles, or if
    the row numbering (XYZ or TMS) does not match what the folder declares."""
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
            f"{folder} contains no map tiles (square PNG, JPEG or WebP of 256 or 512 pixels): give another folder, or "
            "the one that contains the zoom levels (z/x/y.png)."
        )
    if (folder / _TMS_RESOURCE).exists():
        tiles = {(zoom, x, 2**zoom - 1 - y): path for (_, x, y), path in tiles.items()}
    _require_joining_rows(folder, tiles)
    for (_, x, y), path in tiles.items():
        (links / str(x)).mkdir(exist_ok=True)
        (links / str(x) / str(y)).symlink_to(path.absolute())
    (_, left, top), (_, right, bottom) = (edge(list(tiles), axis=0).tolist() for edge in (np.min, np.max))
    across, down, side_px, tile_m = right + 1 - left, bottom + 1 - top, len(first), 2 * HALF_WORLD_M / 2**zoom
    # Missing tiles are transparent, and GDAL does not request coarser zoom levels.
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
    """Raise SourceError if the rows of tiles, numbered from the north, join clearly better in the opposite order."""
    pairs = [(path, tiles[zoom, x, y + 1]) for (zoom, x, y), path in tiles.items() if (zoom, x, y + 1) in tiles]
    expected, opposite = [0.0], [0.0]
    for paths in pairs[:: max(1, len(pairs) // _MAX_JOINS)]:
        upper, lower = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths)
        if _is_square(upper) and _is_square(lower) and upper.shape == lower.shape:
            expected.append(float(cv2.absdiff(upper[-1], lower[0]).mean()))
            opposite.append(float(cv2.absdiff(lower[-1], upper[0]).mean()))
    if sum(opposite) >= _MAX_DIFFERENCE_RATIO * sum(expected):
        return
    if (folder / _TMS_RESOURCE).exists():
        advice = f"north, but {_TMS_RESOURCE} declares them from the south: remove that file if it is wrong"
    else:
        advice = f"south (TMS): write them with `gdal2tiles --xyz`, or put {_TMS_RESOURCE} next to the zoom levels"
    raise SourceError(f"{folder}: the tiles only join if their rows are numbered from the {advice}.")


def _is_square(tile: object) -> TypeGuard[Image]:
    return isinstance(tile, np.ndarray) and tile.shape[0] == tile.shape[1] and not tile.shape[0] & tile.shape[0] - 1
