"""Calibrates a camera with pictures of a chequerboard: finds its inner corners, keeps the views that differ, and
computes the lens. Nothing of a flight imports this module."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edgevpr.core.arrays import Image, Ints, Singles
from edgevpr.core.errors import ConfigError, EdgevprError, ImageError
from edgevpr.core.files import write_whole
from edgevpr.core.types import Frame
from edgevpr.frames.lens import CalibratedLens, line_of_sight

MIN_VIEWS = 8
_ENOUGH_VIEWS = 30
_MAX_VIEWS = 60
_MIN_DISTANCE = 0.03  # mean distance of the corners of two views that differ, as a share of the picture's longest side
_MAX_ERROR = 1 / 1000  # of the longest side: a good calibration has less than half of that
_CELLS = tuple(f"the {row}{column}" for row in ("upper ", "", "lower ") for column in ("left", "middle", "right"))

Size = tuple[int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibratedCamera:
    """The result of a calibration. `pictures`: number of those read, `views` of those used. `error_px`: distance
    between the corners that were found and where the `lens` puts them, root mean square. `corners`: numbers in the nine
    cells of the picture, row by row. `field_deg`: what the lens sees across the longest side. `distortion_px`: the
    most that it moves a pixel of the straightened picture. `advice`: sentences on what would make it better."""

    lens: CalibratedLens
    pictures: int
    views: int
    error_px: float
    corners: tuple[int, ...]
    field_deg: float
    distortion_px: float
    advice: tuple[str, ...]


class BoardViews:
    """The views of a board that differ, as they are collected. `board`: numbers of inner corners along a row and a
    column. `found`: the corners of each view, (N, 2) pixels; `corners`: numbers in the nine cells of the picture, row
    by row; `pictures`: number of pictures searched; `size_px`: their width and height (None: none yet)."""

    def __init__(self, board: Size) -> None:
        self.board, self.pictures = board, 0
        self.size_px: Size | None = None
        self.found: list[Singles] = []
        self.corners: Ints = np.zeros(len(_CELLS), int)

    def add(self, frame: Frame) -> None:
        """Search a frame for the board. Raises ImageError if it has another size than those before."""
        height, width = frame.image.shape[:2]
        self.size_px = self.size_px or (width, height)
        if self.size_px != (width, height):
            raise ImageError(
                f"{frame.name} has {width}x{height} pixels, and the pictures before it {self.size_px[0]}x"
                f"{self.size_px[1]}: give pictures of one camera and size."
            )
        self.pictures += 1
        corners = None if len(self.found) >= _MAX_VIEWS else _find_corners(frame.image, self.board)
        if corners is None:
            return
        either_way = corners, corners[::-1]  # the board may be found from its other end
        distances_px = [np.linalg.norm(one - other, axis=1).mean() for one in either_way for other in self.found]
        if min(distances_px, default=math.inf) > _MIN_DISTANCE * max(self.size_px):
            self.found.append(corners)
            cells = np.clip(corners * 3 / self.size_px, 0, 2).astype(int)
            self.corners += np.bincount(cells[:, 1] * 3 + cells[:, 0], minlength=len(_CELLS))

    def empty_cells(self) -> list[str]:
        """Return the names of the cells of the picture without a corner."""
        return [name for name, count in zip(_CELLS, self.corners, strict=True) if not count]

    def are_enough(self) -> bool:
        """Return True if more views would hardly help."""
        return len(self.found) >= _ENOUGH_VIEWS and not self.empty_cells()


def calibrate(views: BoardViews, path: str, is_fisheye: bool) -> CalibratedCamera:
    """Compute the lens from views of the board. `path` is the file that will name it. Raises EdgevprError, with what to
    do, if the views are too few or fit no lens."""
    if not views.found or views.size_px is None:
        raise EdgevprError(
            f"No board with {views.board[0]}x{views.board[1]} inner corners is in any of {views.pictures} pictures: "
            "count the points where four squares meet (10x7 squares have 9x6), and take pictures that show all of it, "
            "sharp."
        )
    if len(views.found) < MIN_VIEWS:
        raise EdgevprError(
            f"The board is seen in {len(views.found)} views that differ, and {MIN_VIEWS} are needed: take pictures "
            "of it in all parts of the picture, near and far, and tilted."
        )
    lens, error_px = _solve(views, views.size_px, path, is_fisheye)
    if not error_px <= _MAX_ERROR * max(views.size_px):  # NaN as well
        other = "without --fisheye" if is_fisheye else "with --fisheye, if the lens sees more than some 100 degrees"
        raise EdgevprError(
            f"The lens puts corners {error_px:.1f} pixels away from where they are: use a board that is flat, take "
            f"sharp pictures of it at rest, without zoom or digital stabilisation, or try {other}."
        )
    empty = views.empty_cells()
    try:
        sight = line_of_sight(lens, lens.size_px)
    except ConfigError as error:
        raise EdgevprError(f"{error} Hold the board in {', '.join(empty) or 'the corners'} too.") from error
    advice = [f"No corner in {', '.join(empty)}: hold the board there."] if empty else []
    if len(views.found) < 2 * MIN_VIEWS:
        advice.append(f"{len(views.found)} views: twice as many give a more certain lens.")
    ends = np.array([[x, y] for x in (-sight.half[0], 0, sight.half[0]) for y in (-sight.half[1], 0, sight.half[1])])
    moved_px = np.linalg.norm(lens.projected(ends) - (ends * lens.focal_px + lens.centre_px), axis=1)
    return CalibratedCamera(
        lens=lens,
        pictures=views.pictures,
        views=len(views.found),
        error_px=error_px,
        corners=tuple(views.corners.tolist()),
        field_deg=sight.field_deg,
        distortion_px=float(moved_px.max()),
        advice=tuple(advice),
    )


def write_lens(camera: CalibratedCamera) -> None:
    """Write the calibration to its file, as OpenCV's program does. Raises OSError."""
    lens, storage = camera.lens, cv2.FileStorage(".yaml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("image_width", lens.size_px[0])
    storage.write("image_height", lens.size_px[1])
    storage.write("fisheye_model", int(lens.is_fisheye))
    storage.write("camera_matrix", lens.matrix())
    storage.write("distortion_coefficients", np.array(lens.coefficients)[:, None])
    storage.write("avg_reprojection_error", camera.error_px)
    text = storage.releaseAndGetString()
    write_whole(Path(lens.path), lambda unfinished: unfinished.write_text(text))


def _solve(views: BoardViews, size_px: Size, path: str, is_fisheye: bool) -> tuple[CalibratedLens, float]:
    """Return the lens that fits the views best, and its error in pixels. Raises EdgevprError where there is none."""
    columns, rows = views.board
    points = np.zeros((columns * rows, 3), np.float32)  # the corners on the board
    points[:, :2] = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    solve: Any = cv2.calibrateCamera
    flags, start, kind = 0, np.zeros(5), "float32"
    if is_fisheye:
        names: Any = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2  # OpenCV 4, or 5
        flags = names.CALIB_RECOMPUTE_EXTRINSIC | names.CALIB_FIX_SKEW
        solve, start, kind = cv2.fisheye.calibrate, np.zeros(4), "float64"
    seen = [corners[None].astype(kind) for corners in views.found]
    on_board = [points[None].astype(kind)] * len(seen)
    try:
        error_px, matrix, coefficients, *_ = solve(on_board, seen, size_px, np.eye(3), start, flags=flags)
    except cv2.error as error:
        raise EdgevprError(
            "The views fit no lens: take pictures of the board in all parts of the picture, near and far, and tilted."
        ) from error
    (focal_x, _, column), (_, focal_y, row) = matrix[:2].tolist()
    lens = CalibratedLens(
        path=path,
        focal_px=(focal_x, focal_y),
        centre_px=(column, row),
        coefficients=tuple(np.ravel(coefficients).tolist()),
        is_fisheye=is_fisheye,
        size_px=size_px,
    )
    return lens, float(error_px)


def _find_corners(image: Image, board: Size) -> Singles | None:
    """Find the inner corners of the board, (N, 2) pixels, row by row; None: it is not there."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    is_found, found = cv2.findChessboardCornersSB(grey, board, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not is_found:
        return None
    # Found by a model of the whole board, which strong distortion bends: each is moved to where its own edges cross.
    grid = np.asarray(found, np.float32).reshape(board[1], board[0], 2)
    gap_px = min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1))
    half = max(2, int(gap_px / 3))
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.001)
    corners = cv2.cornerSubPix(grey, grid.reshape(-1, 1, 2), (half, half), (-1, -1), until)
    return np.asarray(corners, np.float32).reshape(-1, 2)
