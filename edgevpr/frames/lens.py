"""Lenses with distortion: reads calibrations of OpenCV, ROS and Kalibr, and undistorts images.

An *undistorted* image is the one that a lens without distortion would take from the same place, along the same axis.
Its longest side has the field of view of the calibrated lens (at most `_MAX_UNDISTORTED_FOV_DEG`), so results computed
from a field of view hold for it. A *ray* is a direction from the lens, given by its tangents to the right and down."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from edgevpr.core.arrays import Doubles, Image, Mask, Singles
from edgevpr.core.errors import ConfigError, ImageError
from edgevpr.core.files import read_file
from edgevpr.core.yamlfile import parse_yaml
from edgevpr.frames.images import shrink_image

_MAX_FILE_BYTES = 300_000  # OpenCV's calibration program also writes all chessboard corners to its file
# These parts of OpenCV's files are not YAML. OpenCV's own reader is not used because it crashes on damaged files.
_OPENCV_TAGS = re.compile(rb"^%YAML.*|!!opencv-matrix\b", re.MULTILINE)
_COEFFICIENT_COUNTS = (4, 5, 8, 12, 14)  # supported by OpenCV, beginning with k1 k2 p1 p2; fisheye: only 4
_FISHEYE = "equidistant"
_NO_DISTORTION = "none"
# Names of models in ROS and Kalibr files; "" stands for an OpenCV file.
_MODELS = ("", "plumb_bob", "rational_polynomial", "radtan", _FISHEYE, _NO_DISTORTION)
_MAX_UNDISTORTED_FOV_DEG = 100.0  # of an undistorted image: in a wider one, the corners would waste many pixels
_MAX_SKEW = 0.002  # relative to the focal length; ignored because it shifts points by less than a pixel
_MIN_FOV_DEG = 5.0  # same minimum as `source.fov_deg`
_MAX_OFF_AXIS_DEG = 85.0  # maximum angle from the optical axis at which a lens is sampled
_OFF_AXIS_STEP_DEG = 0.25
_DIRECTIONS_DEG = range(0, 360, 15)  # clockwise from right
_RIGHT = _DIRECTIONS_DEG.index(0)
_DOWN = _DIRECTIONS_DEG.index(90)
_LEFT = _DIRECTIONS_DEG.index(180)
_UP = _DIRECTIONS_DEG.index(270)
_CELL_PX = 8  # the warp is computed at every eighth pixel and interpolated; the error is below 0.1 pixels
_OUTSIDE_PX = -1e6  # so far outside that values interpolated with it are also outside


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibratedLens:
    """A camera calibration. `path`: its file. `focal_px`, `centre_px`: focal lengths and principal point (x, y) in
    images of `size_px` (width, height); the centre of the first pixel is (0, 0). `coefficients`: distortion
    coefficients in the order and number of OpenCV's model (`is_fisheye`: of its fisheye model)."""

    path: str
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    coefficients: tuple[float, ...]
    is_fisheye: bool
    size_px: tuple[int, int]

    def project(self, rays: Doubles) -> Doubles:
        """Project rays (N, 2) to pixels (N, 2)."""
        points = np.ascontiguousarray(np.column_stack([rays, np.ones(len(rays))]))[:, None]
        (focal_x, focal_y), (column, row) = self.focal_px, self.centre_px
        matrix = np.array([[focal_x, 0, column], [0, focal_y, row], [0, 0, 1]])
        project = cv2.fisheye.projectPoints if self.is_fisheye else cv2.projectPoints
        pixels, _ = project(points, np.zeros(3), np.zeros(3), matrix, np.array(self.coefficients))
        return np.asarray(pixels, np.float64).reshape(-1, 2)

    def resize_to(self, size_px: tuple[int, int]) -> "CalibratedLens":
        """Return the calibration scaled to images of another size that cover the same part of the sensor."""
        scale_x, scale_y = size_px[0] / self.size_px[0], size_px[1] / self.size_px[1]
        (focal_x, focal_y), (column, row) = self.focal_px, self.centre_px
        centre_px = scale_x * (column + 0.5) - 0.5, scale_y * (row + 0.5) - 0.5
        return replace(self, focal_px=(scale_x * focal_x, scale_y * focal_y), centre_px=centre_px, size_px=size_px)

    def make_error(self, reason: str) -> ConfigError:
        """Return the error for an impossible calibration."""
        return ConfigError(f"{self.path} is not a valid calibration ({reason}): calibrate the camera again.")


@dataclass(frozen=True, slots=True)
class LensView:
    """The view through a `lens` in images of its size. `half`: ray to the lower right corner of the undistorted
    image. `max_ray`: ray length up to which the distortion model is valid. `full_fov_deg`: field of view across the
    longest side of the distorted image, at most 170."""

    lens: CalibratedLens
    half: tuple[float, float]
    max_ray: float
    full_fov_deg: float

    @property
    def fov_deg(self) -> float:
        """Field of view of the undistorted image across its longest side, degrees."""
        return math.degrees(2 * math.atan(max(self.half)))

    @property
    def undistorted_px(self) -> tuple[int, int]:
        """Size (width, height) of the undistorted image; its longest side is as long as that of the distorted one."""
        longest = max(self.lens.size_px)
        width, height = (max(1, round(longest * tangent / max(self.half))) for tangent in self.half)
        return width, height

    def make_undistortion(self, longest_px: int) -> "Remap":
        """Return the remap to an undistorted image with at most `longest_px` pixels along its longest side."""
        longest = max(self.undistorted_px)
        scale = min(1.0, longest_px / longest)
        width, height = (max(1, round(scale * side)) for side in self.undistorted_px)
        focal_px = scale * longest / 2 / max(self.half)
        out_from_ray = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
        return self.make_remap(out_from_ray, focal_px, (width, height))

    def make_remap(self, out_from_ray: Doubles, out_px: float, size_px: tuple[int, int]) -> "Remap":
        """Return the remap to an image of `size_px` (width, height) with a focal length of `out_px` pixels;
        `out_from_ray` is the homography (3, 3) from rays to its pixels."""
        columns, rows = (np.arange(0, side + _CELL_PX, _CELL_PX) for side in size_px)
        grid_x, grid_y = np.meshgrid(columns, rows)
        rays_xyz = np.stack([grid_x, grid_y, np.ones_like(grid_y)], axis=-1) @ np.linalg.inv(out_from_ray).T
        is_ahead = rays_xyz[..., 2] > 0
        rays_xy = rays_xyz[..., :2] / np.where(is_ahead, rays_xyz[..., 2], 1)[..., None]
        is_valid = is_ahead & (np.hypot(rays_xy[..., 0], rays_xy[..., 1]) <= self.max_ray)
        nodes = self.lens.project(np.where(is_valid[..., None], rays_xy, 0).reshape(-1, 2)).reshape(rays_xy.shape)
        nodes[~is_valid] = _OUTSIDE_PX
        pixel_from_node = np.array([[_CELL_PX, 0, 0], [0, _CELL_PX, 0]], float)
        pixels = np.asarray(cv2.warpAffine(nodes.astype(np.float32), pixel_from_node, size_px), np.float32)
        lower_right = np.array([side - 0.5 for side in self.lens.size_px])
        visible = cv2.inRange(pixels, np.array([-0.5, -0.5]), lower_right).astype(bool)
        return Remap(pixels, visible, max(self.lens.focal_px) / out_px)


@dataclass(frozen=True, slots=True)
class Remap:
    """A warp of a camera's image to (H, W). `pixels` (H, W, 2): source coordinates of each output pixel. `visible` (H,
    W): False where they lie outside the camera's image. `shrink`: source pixels per output pixel, along a side."""

    pixels: Singles
    visible: Mask
    shrink: float

    def warp_mask(self, overlay: Mask) -> Mask:
        """Warp a mask of the camera's image, bool."""
        return _remap_image(overlay.view(np.uint8), self.pixels, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT).view(bool)

    def warp_image(self, image: Image) -> Image:
        """Warp the camera's image. Outside it, its edge is replicated, so that no false gradient arises."""
        shrunk, pixels = shrink_image(image, self.shrink), self.pixels
        if shrunk is not image:
            pixels = pixels + np.float32(0.5)  # makes the only copy: boards have little memory
            pixels *= np.array([shrunk.shape[axis] / image.shape[axis] for axis in (1, 0)], np.float32)
            pixels -= np.float32(0.5)
        return _remap_image(shrunk, pixels, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)


def _remap_image(image: Image, pixels: Singles, interpolation: int, border: int) -> Image:
    # None: the first map holds both coordinates. OpenCV's type stubs demand a second one.
    return cv2.remap(image, pixels, None, interpolation, borderMode=border)  # type: ignore


@lru_cache(maxsize=8)
def compute_lens_view(lens: CalibratedLens, size_px: tuple[int, int]) -> LensView:
    """Return the view through a lens in images of `size_px` (width, height). Raises ImageError if their aspect ratio
    differs from that of the calibration, and ConfigError for an impossible calibration."""
    (width, height), (lens_width, lens_height), (column, row) = size_px, lens.size_px, lens.centre_px
    if not np.isfinite([*lens.focal_px, column, row, *lens.coefficients]).all():
        raise lens.make_error("a value is not a finite number")
    if min(lens.focal_px) <= 0:
        raise lens.make_error("a focal length is not positive")
    if not (0 < column < lens_width and 0 < row < lens_height):
        raise lens.make_error("its principal point lies outside the picture")
    if abs(height - width * lens_height / lens_width) > 1 and abs(width - height * lens_width / lens_height) > 1:
        raise ImageError(
            f"The picture has {width}x{height} pixels, but {lens.path} was calibrated with {lens_width}x{lens_height}: "
            "use pictures with that aspect ratio, or calibrate the camera again."
        )
    lens = lens.resize_to(size_px)
    tangents = np.tan(np.radians(np.arange(0, _MAX_OFF_AXIS_DEG + _OFF_AXIS_STEP_DEG, _OFF_AXIS_STEP_DEG)))
    angles = np.radians(_DIRECTIONS_DEG)
    rays = np.stack([np.outer(np.cos(angles), tangents), np.outer(np.sin(angles), tangents)], axis=-1)
    with np.errstate(all="ignore"):
        offset_px = lens.project(rays.reshape(-1, 2)).reshape(rays.shape) - lens.centre_px
        grows = np.diff(np.hypot(offset_px[..., 0], offset_px[..., 1]), axis=1) > 0  # False for NaN as well
    valid_steps = np.logical_and.accumulate(grows, axis=1).sum(axis=1)  # over which each ray's pixel moves outwards

    def find_edge(direction: int, axis: int, edge_px: float) -> float:
        """Return the tangent of the ray in a direction that meets the edge of the image."""
        steps = slice(valid_steps[direction] + 1)
        distances_px, edge_distance_px = np.abs(offset_px[direction, steps, axis]), abs(edge_px - lens.centre_px[axis])
        if distances_px[-1] < edge_distance_px and valid_steps[direction] < len(tangents) - 1:
            raise lens.make_error("its distortion is not invertible up to the edge of the picture")
        return float(np.interp(edge_distance_px, distances_px, tangents[steps]))

    right, left = find_edge(_RIGHT, 0, width - 0.5), find_edge(_LEFT, 0, -0.5)
    lower, upper = find_edge(_DOWN, 1, height - 0.5), find_edge(_UP, 1, -0.5)
    widest = math.tan(math.radians(_MAX_UNDISTORTED_FOV_DEG / 2))
    half, max_ray = (min(right, left, widest), min(lower, upper, widest)), float(tangents[valid_steps.min()])
    full_fov_deg = math.degrees(sum(map(math.atan, (right, left) if width >= height else (lower, upper))))
    if math.hypot(*half) > max_ray:
        raise lens.make_error("its distortion is not invertible up to the corners of the picture")
    if full_fov_deg < _MIN_FOV_DEG:
        raise lens.make_error(f"its field of view is {full_fov_deg:.1f} degrees")
    return LensView(lens, half, max_ray, full_fov_deg)


def read_lens(path: str) -> CalibratedLens:
    """Read a calibration file of OpenCV (FileStorage as YAML, XML or JSON), ROS (camera_info) or Kalibr (camchain,
    camera cam0). Raises ConfigError for any other file, and for an impossible calibration."""
    try:
        data = read_file(path, _MAX_FILE_BYTES)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror}): choose a readable calibration file.") from error
    content = _read_xml(data, path) if data.lstrip().startswith(b"<") else parse_yaml(_OPENCV_TAGS.sub(b"", data), path)
    fields = {str(name).lower(): value for name, value in content.items()}  # old OpenCV files use capitals
    try:
        lens = _read_kalibr(fields["cam0"], path) if "cam0" in fields else _read_matrix(fields, path)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        fault = f"lacks `{error.args[0]}`" if isinstance(error, KeyError) else "is incomplete"
        advice = "use a calibration file of OpenCV, ROS or Kalibr (docs/how-to/cameras.md)"
        raise ConfigError(f"{path} {fault}: {advice}.") from error
    compute_lens_view(lens, lens.size_px)
    return lens


def _read_matrix(fields: Mapping[str, Any], path: str) -> CalibratedLens:
    """Make the lens from the fields of an OpenCV or ROS file, which have the same names."""
    matrix, coefficients = _read_numbers(fields["camera_matrix"]), _read_numbers(fields["distortion_coefficients"])
    if len(matrix) != 9:
        raise ConfigError(f"{path}: `camera_matrix` has {len(matrix)} numbers, but must have 9.")
    if abs(matrix[1]) > _MAX_SKEW * abs(matrix[0]):
        raise ConfigError(f"{path} has skew (second number of `camera_matrix`): calibrate the camera without skew.")
    model = fields.get("distortion_model", _FISHEYE if int(fields.get("fisheye_model") or 0) else "")
    size_px = int(fields["image_width"]), int(fields["image_height"])
    return _make_lens(path, (matrix[0], matrix[4], matrix[2], matrix[5]), model, coefficients, size_px)


def _read_kalibr(camera: Mapping[str, Any], path: str) -> CalibratedLens:
    if (model := camera["camera_model"]) != "pinhole":
        raise ConfigError(f"{path} has the camera model `{model}`: calibrate the camera with the model `pinhole`.")
    coefficients = _read_numbers(camera.get("distortion_coeffs") or ())
    width, height = map(int, camera["resolution"])
    intrinsics = _read_numbers(camera["intrinsics"])
    return _make_lens(path, intrinsics, camera["distortion_model"], coefficients, (width, height))


def _make_lens(
    path: str, intrinsics: tuple[float, ...], model: str, coefficients: tuple[float, ...], size_px: tuple[int, int]
) -> CalibratedLens:
    """Make a lens. `model`: its distortion model. `intrinsics`: focal lengths, principal point. Raises ConfigError."""
    focal_x, focal_y, column, row = intrinsics
    if model not in _MODELS:
        raise ConfigError(f"{path} has the distortion model `{model}`: calibrate with one of {', '.join(_MODELS[1:])}.")
    if model == _NO_DISTORTION or not coefficients:
        model, coefficients = "", (0.0,) * 4
    if len(coefficients) not in (_COEFFICIENT_COUNTS[:1] if model == _FISHEYE else _COEFFICIENT_COUNTS):
        raise ConfigError(f"{path} has {len(coefficients)} coefficients, which matches no supported distortion model.")
    return CalibratedLens(
        path=path,
        focal_px=(focal_x, focal_y),
        centre_px=(column, row),
        coefficients=coefficients,
        is_fisheye=model == _FISHEYE,
        size_px=size_px,
    )


def _read_numbers(value: Any) -> tuple[float, ...]:
    """Return the numbers of a matrix: a list or, in ROS files, a section with `data`."""
    return tuple(map(float, value["data"] if isinstance(value, dict) else value))


def _read_xml(data: bytes, path: str) -> dict[str, Any]:
    """Read the fields of an OpenCV XML file; matrices are returned in the form used in ROS files."""
    from xml.etree import ElementTree  # rarely needed

    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError) as error:
        raise ConfigError(f"{path} is not valid XML ({error}): use the unmodified file that OpenCV wrote.") from error
    return {node.tag: {"data": (node.findtext("data") or "").split()} if len(node) else node.text for node in root}
