"""A picture of the ground for pages: the map's own pictures, laid by their poses on one raster with north up.

Where pictures overlap, the one whose middle is nearest is shown, and seams are soft. Memory is that of the raster.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from edgevpr.core.arrays import Doubles, Image, Mask
from edgevpr.core.geodesy import axes_of, offset_m
from edgevpr.core.text import progress
from edgevpr.core.types import Place, Pose
from edgevpr.review.album import Album, AlbumPicture

if TYPE_CHECKING:
    from edgevpr.frames.level import Lens

_MOST_PIXELS = 12_000_000
_MOST_SIDE_PX = 12_000
_MOST_BYTES = 4_000_000
_QUALITIES = (70, 50, 30, 15)  # of the WebP file: the first that makes it small enough
_SEAM = 0.12  # width of a seam, as a share of a picture's half side
# Median correlation of a picture with those under it: 0.49 (aerial_swindale) to 0.99 on generated flights and four sets
# where they lie right, 0.12 at most where all are turned by 60 degrees.
_LEAST_LIKENESS = 0.3
_LEAST_PAIRS = 3

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Mosaic:
    """A picture of the ground: `webp`, a file, transparent where no picture shows ground; and its edges (west, south,
    east, north), in metres from the origin of the drawing."""

    webp: bytes
    edges_m: tuple[float, float, float, float]


def lay_mosaic(places: Sequence[Place], album: Album, lens: "Lens | None", origin: Point) -> tuple[Mosaic | None, str]:
    """Lay the pictures of the places that have a pose on a raster around `origin` (lat_deg, lon_deg). `lens` is that of
    the camera (None: unknown): a map made with it is of levelled pictures. Returns the mosaic and "", or None and a
    sentence that says why it cannot be made."""
    spots = [
        _Spot(place, place.pose, np.array(offset_m(*origin, place.position.lat_deg, place.position.lon_deg)))
        for place in places
        if place.position and place.pose
    ]
    if not spots:
        return None, "No place knows how its picture lies on the ground: the ground is drawn without pictures."
    if not album:
        return None, "With --map-images the page shows the map's own pictures under the drawing."
    for each in (lens, None) if lens else (None,):
        raster = None
        for spot in progress(spots, len(spots), "mosaic"):
            if picture := album.level(spot.place, each):
                raster = raster or _Raster(spots, max(picture.image.shape[:2]))
                raster.lay(picture, spot)
        if raster is None:
            return None, "No picture of the map is in --map-images: the ground is drawn without pictures."
        if raster.fits:
            return raster.encode(), ""
    return None, (
        "The pictures of --map-images do not fit each other where the map lays them: the ground is drawn without "
        "pictures. Are they those that the map was made of, with positions.csv and the lens that it was made with?"
    )


@dataclass(frozen=True, slots=True)
class _Spot:
    """A place, its pose, and the middle of its picture, float64 (2,): metres east and north of the origin."""

    place: Place
    pose: Pose
    middle_m: Doubles


class _Raster:
    """A raster that pictures are laid on, for all of `spots`, whose pictures are `side_px` long. `likeness` has, for
    each picture laid over others, their correlation."""

    def __init__(self, spots: Sequence[_Spot], side_px: int) -> None:
        half_m = np.array([[spot.pose.footprint_m / np.sqrt(2)] for spot in spots])  # of the diagonal of a square
        middles_m = np.array([spot.middle_m for spot in spots])
        west_m, south_m = (middles_m - half_m).min(axis=0)
        east_m, north_m = (middles_m + half_m).max(axis=0)
        size_m = np.array([east_m - west_m, north_m - south_m])
        finest_m = min(spot.pose.footprint_m for spot in spots) / side_px
        self._pixel_m = max(finest_m, np.sqrt(size_m.prod() / _MOST_PIXELS), size_m.max() / _MOST_SIDE_PX)
        width, height = np.maximum(1, np.ceil(size_m / self._pixel_m)).astype(int)
        self._corner_m = np.array([west_m, north_m])
        self._edges_m = (west_m, north_m - height * self._pixel_m, west_m + width * self._pixel_m, north_m)
        self._picture = np.zeros((height, width, 3), np.uint8)
        self._weight = np.zeros((height, width), np.uint8)  # of the picture that is shown, 0: none
        self.likeness: list[float] = []

    @property
    def fits(self) -> bool:
        """True unless the pictures contradict each other where they overlap."""
        return len(self.likeness) < _LEAST_PAIRS or float(np.median(self.likeness)) >= _LEAST_LIKENESS

    def lay(self, picture: AlbumPicture, spot: _Spot) -> None:
        """Lay the picture of a place on the raster."""
        from edgevpr.frames.images import at_most, cv2

        sheet = _with_weight(picture.image, picture.mask)
        sheet = at_most(sheet, max(16, round(spot.pose.footprint_m / self._pixel_m)))
        height, width = sheet.shape[:2]
        corners = np.array([[-1, 1, 1, -1], [1, 1, -1, -1]]) * [[width], [height]] / 2  # right and up of the middle
        ground_m = axes_of(spot.pose.up_deg) @ corners * (spot.pose.footprint_m / max(width, height))
        corners_px = ((ground_m.T + spot.middle_m - self._corner_m) / self._pixel_m) * (1, -1)
        limits = np.array(self._weight.shape[::-1])
        low = np.clip(np.floor(corners_px.min(axis=0)), 0, limits).astype(int)
        high = np.clip(np.ceil(corners_px.max(axis=0)) + 1, 0, limits).astype(int)
        if (high <= low).any():
            return
        edges = np.array([[0, 0], [width, 0], [width, height]])
        at = (edges - 0.5).astype(np.float32), (corners_px[:3] - 0.5 - low).astype(np.float32)
        new = np.asarray(cv2.warpAffine(sheet, cv2.getAffineTransform(*at), tuple((high - low).tolist())), np.uint8)
        there = slice(low[1], high[1]), slice(low[0], high[0])
        self._compare(new, self._picture[there], self._weight[there])
        _blend(new, self._picture[there], self._weight[there])

    def _compare(self, new: Image, here: Image, weight: Image) -> None:
        """Note how like a picture is to those under it, where enough of it lies over them."""
        step = max(1, min(weight.shape) // 100)
        both = (new[::step, ::step, 3] > 0) & (weight[::step, ::step] > 0)
        if both.sum() > 0.1 * both.size:
            one, other = (each[::step, ::step, :3].mean(axis=2)[both] for each in (new, here))
            if one.std() > 1 and other.std() > 1:
                self.likeness.append(float(np.corrcoef(one, other)[0, 1]))

    def encode(self) -> Mosaic:
        """Return the raster as a file."""
        from edgevpr.frames.images import small_webp

        image = np.dstack((self._picture, np.where(self._weight > 0, 255, 0).astype(np.uint8)))
        files = (small_webp(image, _MOST_SIDE_PX, quality) for quality in _QUALITIES)
        webp = next((file for file in files if len(file) <= _MOST_BYTES), b"")
        return Mosaic(webp or small_webp(image, _MOST_SIDE_PX, _QUALITIES[-1]), self._edges_m)


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
