"""A picture of the ground for pages: the map's own pictures, laid by their poses on one raster with north up.

Where pictures overlap, the one whose middle is nearest is shown, and seams are soft. Memory is that of the raster.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from edgevpr.core.arrays import Doubles, Image, Mask
from edgevpr.core.geodesy import axes_of, offset_m
from edgevpr.core.text import progress
from edgevpr.core.types import Place, Pose, Position
from edgevpr.review.album import Album

if TYPE_CHECKING:
    from edgevpr.frames.level import Lens

_MOST_PIXELS, _MOST_SIDE_PX, _MOST_BYTES = 12_000_000, 12_000, 4_000_000
_QUALITIES = (70, 50, 30, 15)  # of the WebP file: the first that makes it small enough
_ROWS = 256
_SEAM = 0.12  # width of a seam, as a share of a picture's half side
# Median correlation of a picture with those under it: 0.49 (aerial_swindale) to 0.99 on generated flights and four sets
# where they lie right, 0.12 at most where all are turned by 60 degrees.
_LEAST_LIKE, _LEAST_PAIRS = 0.3, 3

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Mosaic:
    """A picture of the ground: `webp`, a file, transparent where no picture shows ground; and its edges (west, south,
    east, north), in metres from the origin of the drawing."""

    webp: bytes
    edges_m: tuple[float, float, float, float]


def mosaic_of(places: Sequence[Place], album: Album, lens: "Lens | None", origin: Point) -> Mosaic | str:
    """Lay the pictures of the places that have a pose on a raster around `origin` (lat_deg, lon_deg). `lens` is that of
    the camera (None: unknown): a map made with it is of levelled pictures. Returns a sentence where it cannot be made.
    """
    posed = [(place, place.position, place.pose) for place in places if place.position and place.pose]
    if not posed:
        return "No place knows how its picture lies on the ground: the ground is drawn without pictures."
    if not album:
        return "With --map-images the page shows the map's own pictures under the drawing."
    for each in (lens, None) if lens else (None,):
        canvas = _laid([place for place, *_ in posed], album, each, origin)
        if canvas is None:
            return "No picture of the map is in --map-images: the ground is drawn without pictures."
        if canvas.fits:
            return canvas.encoded()
    return (
        "The pictures of --map-images do not fit each other where the map lays them: the ground is drawn without "
        "pictures. Are they those that the map was made of, with positions.csv and the lens that it was made with?"
    )


def _laid(places: Sequence[Place], album: Album, lens: "Lens | None", origin: Point) -> "_Canvas | None":
    """Lay all pictures on a new canvas; None if none is found."""
    canvas = None
    for place in progress(places, len(places), "mosaic"):
        if laid := album.laid(place, lens):
            canvas = canvas or _Canvas(places, origin, max(laid[0].shape[:2]))
            canvas.lay(*laid, place)
    return canvas


class _Canvas:
    """A raster that pictures are laid on. `likeness` has, for each picture laid over others, their correlation."""

    def __init__(self, places: Sequence[Place], origin: Point, side_px: int) -> None:
        self._origin = origin
        squares = np.concatenate([_middle(place, origin) + _half(place) * np.array([[-1], [1]]) for place in places])
        (west, south), (east, north) = squares.min(axis=0), squares.max(axis=0)
        finest_m = min(_pose(place).footprint_m for place in places) / side_px
        wide_m, high_m = east - west, north - south
        self._pixel_m = max(
            finest_m, np.sqrt(wide_m * high_m / _MOST_PIXELS), wide_m / _MOST_SIDE_PX, high_m / _MOST_SIDE_PX
        )
        width, height = (max(1, int(np.ceil(side_m / self._pixel_m))) for side_m in (wide_m, high_m))
        self._west, self._north = west, north
        self._edges_m = (west, north - height * self._pixel_m, west + width * self._pixel_m, north)
        self._picture = np.zeros((height, width, 3), np.uint8)
        self._weight = np.zeros((height, width), np.uint8)  # of the picture that is shown, 0: none
        self.likeness: list[float] = []

    @property
    def fits(self) -> bool:
        """True unless the pictures contradict each other where they overlap."""
        return len(self.likeness) < _LEAST_PAIRS or float(np.median(self.likeness)) >= _LEAST_LIKE

    def lay(self, image: Image, mask: Mask | None, place: Place) -> None:
        """Lay the picture of a place, uint8 (H, W[, 3]), on the canvas, but for pixels where `mask` is False."""
        from edgevpr.frames.images import at_most, cv2

        sheet = _with_weight(image, mask)
        sheet = at_most(sheet, max(16, round(_pose(place).footprint_m / self._pixel_m)))
        way = self._way(sheet.shape[:2], place)
        height, width = sheet.shape[:2]
        corners = way @ np.array([[0, width, 0, width], [0, 0, height, height], [1, 1, 1, 1]])
        limits = np.array(self._weight.shape[::-1])
        low = np.clip(np.floor(corners.min(axis=1)), 0, limits).astype(int)
        high = np.clip(np.ceil(corners.max(axis=1)) + 1, 0, limits).astype(int)
        if (high <= low).any():
            return
        way[:, 2] -= low
        new = np.asarray(cv2.warpAffine(sheet, way, tuple((high - low).tolist())), np.uint8)
        there = slice(low[1], high[1]), slice(low[0], high[0])
        self._compare(new, self._picture[there], self._weight[there])
        for top in range(0, len(new), _ROWS):  # the numbers of a large picture would take much memory
            rows = slice(top, top + _ROWS)
            _blend(new[rows], self._picture[there][rows], self._weight[there][rows])

    def _way(self, shape: tuple[int, ...], place: Place) -> Doubles:
        """Return the affine map (2, 3) from the pixels of a place's picture to those of the canvas."""
        pose, (height, width) = _pose(place), shape
        axes = axes_of(pose.up_deg) * (pose.footprint_m / max(shape) / self._pixel_m)
        turn = np.array([[1.0], [-1.0]]) * axes * np.array([1.0, -1.0])  # rows of pixels go down, north goes up
        east, north = _middle(place, self._origin)[0]
        middle = np.array([east - self._west, self._north - north]) / self._pixel_m - 0.5
        return np.column_stack((turn, middle - turn @ np.array([(width - 1) / 2, (height - 1) / 2])))

    def _compare(self, new: Image, here: Image, weight: Image) -> None:
        """Note how like a picture is to those under it, where enough of it lies over them."""
        step = max(1, min(weight.shape) // 100)
        both = (new[::step, ::step, 3] > 0) & (weight[::step, ::step] > 0)
        if both.sum() > 0.1 * both.size:
            one, other = (each[::step, ::step, :3].mean(axis=2)[both] for each in (new, here))
            if one.std() > 1 and other.std() > 1:
                self.likeness.append(float(np.corrcoef(one, other)[0, 1]))

    def encoded(self) -> Mosaic:
        """Return the canvas as a file."""
        from edgevpr.frames.images import small_webp

        seen = np.dstack((self._picture, np.where(self._weight > 0, 255, 0).astype(np.uint8)))
        webp = b""
        for quality in _QUALITIES:
            webp = small_webp(seen, _MOST_SIDE_PX, quality)
            if len(webp) <= _MOST_BYTES:
                break
        return Mosaic(webp, self._edges_m)


def _blend(new: Image, here: Image, weight: Image) -> None:
    """Lay `new`, uint8 (H, W, 4) with its weight, over the picture `here` (H, W, 3) of the `weight` (H, W)."""
    share = np.clip((new[..., 3] - weight.astype(np.float32)) / (255 * _SEAM) + 0.5, 0, 1)
    share = np.where(weight == 0, 1, share) * (new[..., 3] > 0)
    here[:] = np.rint(here + share[..., None] * (new[..., :3] - here.astype(np.float32)))
    np.maximum(weight, new[..., 3], out=weight)


def _with_weight(image: Image, mask: Mask | None) -> Image:
    """Return a picture, uint8 (H, W, 4): its colours, and as fourth its weight, from 255 in the middle to 1 at the
    edge, and 0 where `mask` is False."""
    colours = np.broadcast_to(image[..., None] if image.ndim == 2 else image[..., :3], (*image.shape[:2], 3))
    across, along = (1 - abs(np.linspace(-1, 1, side)) for side in image.shape[1::-1])
    weight = 1 + 254 * np.minimum(across[None], along[:, None])
    return np.dstack((colours, weight if mask is None else weight * mask)).astype(np.uint8)


def _pose(place: Place) -> Pose:
    assert place.pose is not None  # only places with a pose are laid
    return place.pose


def _half(place: Place) -> float:
    """Return half the diagonal of the square that a picture may show, metres."""
    return _pose(place).footprint_m / math.sqrt(2)


def _middle(place: Place, origin: Point) -> Doubles:
    """Return the middle of a picture, float64 (1, 2): metres east and north of the origin."""
    at = place.position
    assert isinstance(at, Position)  # only places with a position are laid
    return np.array([offset_m(*origin, at.lat_deg, at.lon_deg)])
