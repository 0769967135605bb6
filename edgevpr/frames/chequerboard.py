"""Calibrates a camera with pictures of a chequerboard: finds its inner corners, keeps the views that differ, and
computes the lens. Nothing of a flight imports this module."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edgevpr.core.arrays import Doubles, Image, Ints, Singles
from edgevpr.core.errors import ConfigError, EdgevprError, ImageError
from edgevpr.core.files import write_whole
from edgevpr.core.types import Frame
from edgevpr.frames.lens import CalibratedLens, sight_of
from edgevpr.frames.source import Source

LEAST_VIEWS, ENOUGH_VIEWS, _MOST_VIEWS = 8, 30, 60
_APART = 0.03  # mean distance of the corners of two views that differ, as a share of the picture's longest side
_OUTLIER = 3.0  # times the median error: a view that is blurred, or was taken in a jerk
_MOST_ERROR = 1 / 1000  # of the longest side: a good calibration has less than half of that
_TILTED_DEG, _LEAST_TILTED = 15.0, 4  # views that look at the board from aside: they tell the focal length
_CELLS = tuple(f"{row}{column}" for row in ("upper ", "", "lower ") for column in ("left", "middle", "right"))
_READ_S = 0.25

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
    column. `found`: the corners of each view, (N, 2) pixels; `pictures`: number of pictures looked at; `size_px`: their
    width and height (None: none yet)."""

    def __init__(self, board: Size) -> None:
        self.board, self.pictures = board, 0
        self.size_px: Size | None = None
        self.found: list[Singles] = []

    def look(self, frame: Frame) -> None:
        """Look for the board in a frame. Raises ImageError if it has another size than those before."""
        height, width = frame.image.shape[:2]
        self.size_px = self.size_px or (width, height)
        if self.size_px != (width, height):
            raise ImageError(
                f"{frame.name} has {width}x{height} pixels, and the pictures before it {self.size_px[0]}x"
                f"{self.size_px[1]}: give pictures of one camera and size."
            )
        self.pictures += 1
        corners = None if len(self.found) >= _MOST_VIEWS else _corners(frame.image, self.board)
        if corners is None:
            return
        # The board may be found from its other end.
        if all(
            min(_apart(corners, each), _apart(corners[::-1], each)) > _APART * max(self.size_px) for each in self.found
        ):
            self.found.append(corners)

    def corners(self) -> Ints:
        """Return the number of corners in each of nine cells of the picture, row by row."""
        if not self.found or not self.size_px:
            return np.zeros(len(_CELLS), int)
        cells = np.clip(np.concatenate(self.found) * 3 / self.size_px, 0, 2).astype(int)
        return np.bincount(cells[:, 1] * 3 + cells[:, 0], minlength=len(_CELLS))

    def empty_cells(self) -> list[str]:
        """Return the names of the cells without a corner."""
        return [name for name, count in zip(_CELLS, self.corners(), strict=True) if not count]

    def are_enough(self) -> bool:
        """Return True if more views would hardly help."""
        return len(self.found) >= ENOUGH_VIEWS and not self.empty_cells()


def live_frames(source: Source, seconds: float, clock: Callable[[], float] = time.monotonic) -> Iterator[Frame]:
    """Yield the newest frames of a live source for so many seconds."""
    end_s = clock() + seconds
    while clock() < end_s and not source.ended:
        if frame := source.read(_READ_S):
            yield frame


def calibrated(views: BoardViews, path: str, is_fisheye: bool) -> CalibratedCamera:
    """Compute the lens from views of the board. `path` is the file that will name it. Raises EdgevprError, with what to
    do, if the views are too few or fit no lens."""
    columns, rows = views.board
    if not views.found or views.size_px is None:
        raise EdgevprError(
            f"No board with {columns}x{rows} inner corners is in any of {views.pictures} pictures: count the points "
            "where four squares meet (10x7 squares have 9x6), and take pictures that show all of it, sharp."
        )
    if len(views.found) < LEAST_VIEWS:
        raise EdgevprError(
            f"The board is seen in {len(views.found)} views that differ, and {LEAST_VIEWS} are needed: take pictures "
            "of it in all parts of the picture, near and far, and tilted."
        )
    points = np.zeros((columns * rows, 3), np.float32)
    points[:, :2] = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    found = views.found
    solved = _solved(found, points, views.size_px, is_fisheye)
    usual = float(np.median(solved.errors_px))
    kept = [each for each, error_px in zip(found, solved.errors_px, strict=True) if error_px <= _OUTLIER * usual]
    if LEAST_VIEWS <= len(kept) < len(found):
        found, solved = kept, _solved(kept, points, views.size_px, is_fisheye)
    lens, error_px = solved.lens(path, is_fisheye, views.size_px), float(np.sqrt(np.mean(solved.errors_px**2)))
    if not error_px <= _MOST_ERROR * max(views.size_px):  # NaN as well
        other = "without --fisheye" if is_fisheye else "with --fisheye, if the lens sees more than some 100 degrees"
        raise EdgevprError(
            f"The lens puts corners {error_px:.1f} pixels away from where they are: use a board that is flat, take "
            f"sharp pictures of it at rest, without zoom or digital stabilisation, or try {other}."
        )
    try:
        sight = sight_of(lens, lens.size_px)
    except ConfigError as error:
        raise EdgevprError(f"{error} Hold the board in {_listed(views.empty_cells()) or 'the corners'} too.") from error
    ends = np.array([[x, y] for x in (-sight.half[0], 0, sight.half[0]) for y in (-sight.half[1], 0, sight.half[1])])
    moved_px = np.linalg.norm(lens.projected(ends) - (ends * lens.focal_px + lens.centre_px), axis=1).max()
    return CalibratedCamera(
        lens=lens,
        pictures=views.pictures,
        views=len(found),
        error_px=error_px,
        corners=tuple(views.corners().tolist()),
        field_deg=sight.field_deg,
        distortion_px=float(moved_px),
        advice=tuple(_advice(views, solved)),
    )


def write_lens(camera: CalibratedCamera) -> None:
    """Write the calibration to its file, as OpenCV's program does. Raises OSError."""
    lens, storage = camera.lens, cv2.FileStorage(".yaml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    (focal_x, focal_y), (column, row) = lens.focal_px, lens.centre_px
    storage.write("image_width", lens.size_px[0])
    storage.write("image_height", lens.size_px[1])
    storage.write("fisheye_model", int(lens.is_fisheye))
    storage.write("camera_matrix", np.array([[focal_x, 0, column], [0, focal_y, row], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array(lens.coefficients)[:, None])
    storage.write("avg_reprojection_error", camera.error_px)
    text = storage.releaseAndGetString()
    write_whole(Path(lens.path), lambda unfinished: unfinished.write_text(text))


@dataclass(frozen=True, slots=True)
class _Solved:
    """The result of OpenCV: camera matrix (3, 3), coefficients, error of each view, and how far each view is tilted."""

    matrix: Doubles
    coefficients: Doubles
    errors_px: Doubles
    tilts_deg: Doubles

    def lens(self, path: str, is_fisheye: bool, size_px: Size) -> CalibratedLens:
        (focal_x, _, column), (_, focal_y, row) = self.matrix[:2].tolist()
        return CalibratedLens(
            path=path,
            focal_px=(focal_x, focal_y),
            centre_px=(column, row),
            coefficients=tuple(self.coefficients.tolist()),
            is_fisheye=is_fisheye,
            size_px=size_px,
        )


def _solved(found: Sequence[Singles], points: Singles, size_px: Size, is_fisheye: bool) -> _Solved:
    """Compute the lens. `points` (N, 3) are the corners on the board. Raises EdgevprError where OpenCV cannot."""
    try:
        if is_fisheye:
            named: Any = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2  # OpenCV 4, or 5
            flags = named.CALIB_RECOMPUTE_EXTRINSIC | named.CALIB_FIX_SKEW
            on_board, seen = [points[None].astype(float)] * len(found), [each[None].astype(float) for each in found]
            start, none = np.eye(3), np.zeros(4)
            _, matrix, coefficients, turns, shifts = cv2.fisheye.calibrate(
                on_board, seen, size_px, start, none, flags=flags
            )
        else:
            start, none = np.eye(3), np.zeros(5)
            _, matrix, coefficients, turns, shifts = cv2.calibrateCamera(
                [points] * len(found), found, size_px, start, none
            )
    except cv2.error as error:
        raise EdgevprError(
            "The views fit no lens: take pictures of the board in all parts of the picture, near and far, and tilted."
        ) from error
    project = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
    errors_px, tilts_deg = [], []
    for each, turn, shift in zip(found, turns, shifts, strict=True):
        expected, _ = project(points[:, None].astype(float), turn, shift, matrix, coefficients)
        errors_px.append(math.sqrt(np.mean(np.sum((expected.reshape(-1, 2) - each) ** 2, axis=1))))
        tilts_deg.append(math.degrees(math.acos(min(1.0, abs(cv2.Rodrigues(turn)[0][2, 2])))))
    coefficients = np.asarray(coefficients).ravel()
    return _Solved(
        np.asarray(matrix, np.float64), np.asarray(coefficients, np.float64), np.array(errors_px), np.array(tilts_deg)
    )


def _advice(views: BoardViews, solved: _Solved) -> Iterator[str]:
    if empty := views.empty_cells():
        yield f"No corner in {_listed(empty)}: hold the board there."
    if (solved.tilts_deg > _TILTED_DEG).sum() < _LEAST_TILTED:
        yield f"Hardly a view is tilted by more than {_TILTED_DEG:.0f} degrees: tilt the board, for the focal length."
    if len(views.found) < 2 * LEAST_VIEWS:
        yield f"{len(views.found)} views: twice as many make it surer."


def _listed(cells: Iterable[str]) -> str:
    return ", ".join(f"the {name}" for name in cells)


def _corners(image: Image, board: Size) -> Singles | None:
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


def _apart(one: Singles, other: Singles) -> float:
    return float(np.linalg.norm(one - other, axis=1).mean())
