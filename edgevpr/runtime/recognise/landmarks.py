"""Landmarks of an image: points that can be found again in other images of the same ground, described by 256 bits.

The points are FAST corners and the bits are ORB descriptors (Rublee et al. 2011). A place keeps few of them, spread
over the image. A query has more, so that most of the place's visible points are among them."""

import struct
from dataclasses import dataclass

import cv2
import numpy as np

from edgevpr.core.arrays import Bytes, Image, Ints, Mask, Singles

PLACE_LANDMARKS = 250
QUERY_LANDMARKS = 1000
# Ahead, smaller images work at least as well: across seasons, more correct matches agree than at 640 pixels.
DOWN_PX = 640  # longest side
AHEAD_PX = 320
_MIN_CORNERS = 4 * PLACE_LANDMARKS  # least number of corners to choose from
_LEVELS = 8  # of the pyramid
_LEVEL_FACTOR = 1.2
_MIN_CONTRAST = 5  # grey levels between a corner and its surroundings; low, so that dark images have corners
_PATCH_PX = 31  # width of the patch that describes a point, on its level of the pyramid
_CELLS = 8  # along the longest side; each has about the same number of points
_MIN_DISTANCE_PX = 3.0  # a corner found on several levels of the pyramid is one landmark

_VERSION = 1
_HEADER = struct.Struct("<BH")
_STORED_DTYPE = np.dtype([("x", "<u2"), ("y", "<u2"), ("angle", "u1"), ("size", "u1"), ("bits", "u1", 32)])
_SIZE_RESOLUTION = 0.001  # resolution of stored sizes, as a fraction of the longest side


@dataclass(frozen=True, slots=True)
class Landmarks:
    """K points of an image, best first.

    `points` float32 (K, 2): x to the right and y down from the centre, as fractions of the longest side, so that images
    of different sizes are comparable. `angle_deg` float32 (K,): direction, clockwise from the right. `size` float32
    (K,): width of the described patch, as a fraction of the longest side. `bits` uint8 (K, 32): the descriptor."""

    points: Singles
    angle_deg: Singles
    size: Singles
    bits: Bytes

    def __len__(self) -> int:
        return len(self.points)

    def select_best(self, count: int) -> "Landmarks":
        """Return the `count` best landmarks."""
        return Landmarks(self.points[:count], self.angle_deg[:count], self.size[:count], self.bits[:count])


def detect_landmarks(
    image: Image, mask: Mask | None = None, count: int = PLACE_LANDMARKS, longest_px: int = DOWN_PX
) -> Landmarks:
    """Detect the `count` best landmarks of a uint8 image, (H, W) grey or (H, W, 3) BGR, scaled to `longest_px` along
    its longest side, best first; none if it has no corners or is smaller than a patch. No patch covers a pixel where
    `mask`, bool (H, W), is False."""
    height, width = image.shape[:2]
    scale = longest_px / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    allowed = None
    if mask is not None:
        allowed = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        allowed = cv2.erode(allowed, np.ones((_PATCH_PX, _PATCH_PX), np.uint8), borderValue=1)
    orb = cv2.ORB.create(
        max(count, _MIN_CORNERS), _LEVEL_FACTOR, _LEVELS, fastThreshold=_MIN_CONTRAST, patchSize=_PATCH_PX
    )
    keypoints, bits = orb.detectAndCompute(grey, allowed) if min(size) > 2 * _PATCH_PX else ((), None)
    if bits is None:
        none = np.empty(0, np.float32)
        return Landmarks(np.empty((0, 2), np.float32), none, none, np.empty((0, 32), np.uint8))
    points_px: Singles = np.array([point.pt for point in keypoints], np.float32)
    order = np.argsort([-point.response for point in keypoints], kind="stable")
    selected = order[_select_spread(points_px[order], count, longest_px / _CELLS)]
    centre = (np.array(size, np.float32) - 1) / 2
    width_px = np.array([point.size for point in keypoints], np.float32)
    return Landmarks(
        np.asarray(((points_px - centre) / longest_px)[selected], np.float32),
        np.array([point.angle for point in keypoints], np.float32)[selected],
        np.asarray(width_px[selected] / longest_px, np.float32),
        np.asarray(bits[selected], np.uint8),
    )


def _select_spread(points_px: Singles, count: int, cell_px: float) -> Ints:
    """Return the indices of at most `count` of the points (K, 2), ordered best first, spread over the image: the best
    one in every cell of a grid, then the second best, and so on."""
    # Keep only the best of several points at one corner.
    _, first = np.unique(np.rint(points_px / _MIN_DISTANCE_PX).astype(int), axis=0, return_index=True)
    unique = np.sort(first)
    _, cell = np.unique((points_px[unique] // cell_px).astype(int), axis=0, return_inverse=True)
    by_cell = np.argsort(cell.ravel(), kind="stable")
    ordered = cell.ravel()[by_cell]
    starts = np.searchsorted(ordered, ordered)
    rank = np.empty(len(unique), int)
    rank[by_cell] = np.arange(len(unique)) - starts
    return unique[np.argsort(rank, kind="stable")[:count]]


def pack_bytes(landmarks: Landmarks) -> bytes:
    """Encode landmarks for map files: a header of 3 bytes, then 38 bytes for each."""
    stored = np.empty(len(landmarks), _STORED_DTYPE)
    coordinates = np.rint((landmarks.points.astype(np.float64) + 0.5) * 65535).clip(0, 65535)
    stored["x"], stored["y"] = coordinates[:, 0], coordinates[:, 1]
    stored["angle"] = np.rint(landmarks.angle_deg * (256 / 360)).astype(int) % 256
    stored["size"] = np.rint(landmarks.size / _SIZE_RESOLUTION).clip(0, 255)
    stored["bits"] = landmarks.bits
    return _HEADER.pack(_VERSION, len(stored)) + stored.tobytes()


def unpack_bytes(blob: bytes) -> Landmarks:
    """Decode landmarks from the bytes of `pack_bytes`. Raises ValueError for anything else."""
    version, count = _HEADER.unpack(blob[: _HEADER.size].ljust(_HEADER.size, b"\0"))
    if version != _VERSION or len(blob) != _HEADER.size + count * _STORED_DTYPE.itemsize:
        raise ValueError("its landmarks have a format that this version of edgevpr does not recognise")
    stored = np.frombuffer(blob, _STORED_DTYPE, offset=_HEADER.size)
    points = np.stack([stored["x"], stored["y"]], axis=1).astype(np.float64) / 65535 - 0.5
    return Landmarks(
        points.astype(np.float32),
        stored["angle"].astype(np.float32) * np.float32(360 / 256),
        stored["size"].astype(np.float32) * np.float32(_SIZE_RESOLUTION),
        stored["bits"],
    )
