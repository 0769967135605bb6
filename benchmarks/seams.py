"""Which seams of a raster `edgevpr map build` sees: `make from-space`.

The rasters are those of sat_marash, of both days, in windows of 512 pixels that overlap by half; the pictures are
those of all sets from the air, where there are no seams. The mosaics have the raster `before` and, in every other
stripe of 400 m that lies at 12 degrees to north, or in every other square of 128 m, the other day, or the same one
half as bright again. The other day has the mean and the spread of each colour that `before` has. The limit was chosen
on these rasters and pictures.
"""

from collections.abc import Iterator
from pathlib import Path

import base
import cv2
import numpy as np
import rasterio
from base import Row

from edgevpr.core.arrays import Image
from edgevpr.frames.images import read_image
from edgevpr.mapmaking.seams import WINDOW_PX, has_seam

SET, _STEP_PX, _TURN_RAD = "sat_marash", WINDOW_PX // 2, np.radians(12)
_STRIPE_PX, _SQUARE_PX, _SOFT_PX = 800, 256, 40
_COLUMNS = {"ground": "{ground}", "looked at": "{tried}", "with a seam": "{seams}"}


def raster(path: Path) -> Image:
    with rasterio.open(path) as opened:
        return np.ascontiguousarray(opened.read()[::-1].transpose(1, 2, 0))


def windows(ground: Image) -> Iterator[Image]:
    high, wide = ground.shape[:2]
    for row in range(0, high - WINDOW_PX + 1, _STEP_PX):
        for column in range(0, wide - WINDOW_PX + 1, _STEP_PX):
            yield ground[row : row + WINDOW_PX, column : column + WINDOW_PX]


def alike(ground: Image, other: Image) -> Image:
    """Return `other` with the mean and the spread that each colour has in `ground`."""
    (mean, sd), (others_mean, others_sd) = (cv2.meanStdDev(each) for each in (ground, other))
    return np.uint8(np.clip((other - others_mean.T) / others_sd.T * sd.T + mean.T, 0, 255))


def mosaics(before: Image, after: Image) -> Iterator[tuple[str, Image]]:
    row, column = np.indices(before.shape[:2])
    across_px = column * np.cos(_TURN_RAD) + row * np.sin(_TURN_RAD)
    striped = (across_px // _STRIPE_PX % 2)[..., None]
    squared = ((column // _SQUARE_PX + row // _SQUARE_PX) % 2)[..., None]
    soft = cv2.blur(striped.astype(np.float32), (_SOFT_PX, _SOFT_PX))[..., None]
    other, brighter = alike(before, after), np.minimum(1.5 * before, 255)
    for name, part, here in (
        ("stripes of another day", striped, other),
        ("stripes half as bright again", striped, brighter),
        ("stripes a fifth brighter", striped, np.minimum(1.2 * before, 255)),
        ("stripes of another day that fade in over 20 m", soft, other),
        ("squares of another day", squared, other),
        ("squares half as bright again", squared, brighter),
    ):
        yield name, np.uint8(part * here + (1 - part) * before)


def row_of(ground: str, images: list[Image]) -> Row:
    seams = sum(has_seam(image, np.ones(image.shape[:2], bool)) for image in images)
    return {"ground": ground, "tried": len(images), "seams": seams}


def main() -> None:
    (folder,) = base.find_sets(names=[SET])
    before, after = (raster(folder / "raster" / f"{day}.vrt") for day in ("before", "after"))
    rows = [row_of(name, list(windows(ground))) for name, ground in (("before", before), ("after", after))]
    for each in base.find_sets(camera="nadir"):
        paths = sorted([*(each / "ref").iterdir(), *(each / "query").iterdir()])
        rows.append(row_of(each.name, [read_image(path)[:WINDOW_PX, :WINDOW_PX] for path in paths]))
    rows += [row_of(name, list(windows(mosaic))) for name, mosaic in mosaics(before, after)]
    found = {**base.made_by(), "rows": rows}
    base.write("seams", found, page(found))


def page(found: Row) -> str:
    return f"""# Seams of rasters

{base.told(__doc__)}

{base.table(found["rows"], _COLUMNS)}

{base.made_line(found, "make from-space")}
"""


if __name__ == "__main__":
    base.run(main)
