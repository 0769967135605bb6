"""Renders pictures of a scene by a camera under a drone: lighting, a pinhole camera and its sensor's imperfections."""

from dataclasses import dataclass

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Doubles, Image
from edgevpr.lab.simulate.brush import Scene, make_noise, smooth_step

_MAX_SHADOW_M = 30.0
_STRIP_ROWS = 256  # rows lit at a time, to limit the working memory


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """Lighting by time of day and weather. `warmth` shifts sunlight from blue (-1) to orange (+1). `cloud_frac` is the
    fraction (0..1) of the ground in cloud shadow, and `haze_frac` that of grey haze in the picture. `exposure` is a
    brightness factor, `gamma` an exponent."""

    sun_azimuth_deg: float
    sun_elevation_deg: float
    warmth: float = 0.0
    cloud_frac: float = 0.0
    haze_frac: float = 0.0
    exposure: float = 1.0
    gamma: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """A pinhole camera that looks straight down, with the top of its picture towards the nose of the aircraft.
    `noise_sigma`: sensor noise in grey levels. `blur_px`: motion blur along the direction of flight."""

    width: int = 640
    height: int = 480
    focal_px: float = 493.0  # 66 degrees across
    noise_sigma: float = 2.0
    blur_px: float = 0.0
    jpeg_quality: int = 88


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPose:
    """Position and attitude of the camera. Positions are metres from the scene's south-west corner and above ground.
    Angles are those of the airframe in degrees: heading clockwise from north, roll right wing down, pitch nose up."""

    east_m: float = 0.0
    north_m: float = 0.0
    height_m: float
    heading_deg: float
    roll_deg: float = 0.0
    pitch_deg: float = 0.0


def ground_to_pixel(pose: CameraPose, camera: Camera) -> Doubles:
    """Return the homography (3, 3) from the ground plane (east, north in metres, 1) to the picture (column, row, 1)."""
    yaw, pitch, roll = np.radians((pose.heading_deg, pose.pitch_deg, pose.roll_deg))
    about_down = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    about_right = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    about_nose = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    body_from_ned = (about_down @ about_right @ about_nose).T
    lens_from_body = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # right, back, down
    ned_from_ground = np.array([[0, 1, -pose.north_m], [1, 0, -pose.east_m], [0, 0, pose.height_m]])
    pixel_from_lens = np.array(
        [[camera.focal_px, 0, (camera.width - 1) / 2], [0, camera.focal_px, (camera.height - 1) / 2], [0, 0, 1]]
    )
    return np.asarray(pixel_from_lens @ lens_from_body @ body_from_ned @ ned_from_ground)


def light_scene(scene: Scene, light: Light, seed: int) -> Image:
    """Light the scene: returns uint8 (H, W, 3) BGR with shaded slopes, cast shadows, and cloud shadows from `seed`."""
    azimuth, elevation = np.radians((light.sun_azimuth_deg, light.sun_elevation_deg))
    towards_sun = float(np.sin(azimuth)), float(-np.cos(azimuth))  # in columns and rows
    shadow = _cast_shadows(scene, towards_sun, float(np.tan(elevation)))
    sky = np.array([0.42, 0.36, 0.32], np.float32)
    sun = np.array([0.64 - 0.12 * light.warmth, 0.66, 0.68 + 0.10 * light.warmth], np.float32)
    cloud = _make_clouds(scene, light.cloud_frac, seed)
    ground = np.empty_like(scene.albedo)
    for top in range(0, len(ground), _STRIP_ROWS):
        rows = slice(top, top + _STRIP_ROWS)
        padded_cm = scene.height_cm[max(0, top - 1) : top + _STRIP_ROWS + 1].astype(np.float32)
        down, right = (np.gradient(padded_cm, 100 * scene.metres_per_pixel, axis=axis) for axis in (0, 1))
        inner = slice(top - max(0, top - 1), None)
        down, right = down[inner][:_STRIP_ROWS], right[inner][:_STRIP_ROWS]
        slope = np.sin(elevation) - np.cos(elevation) * (right * towards_sun[0] + down * towards_sun[1])
        slope = np.clip(slope / np.sqrt(1 + right**2 + down**2) / np.sin(elevation), 0.05, 1.9)
        direct = slope * (1 - shadow[rows] / np.float32(255)) * (1 - cloud[rows] / np.float32(255))
        ground[rows] = np.clip(scene.albedo[rows] * (sky + sun * direct[..., None]), 0, 255)
    return ground


def _cast_shadows(scene: Scene, towards_sun: tuple[float, float], steepness: float) -> Array:
    """Compute the shadow mask, uint8 (H, W), 255 where something blocks the sun. `towards_sun` (column, row) is a step
    of one pixel towards the sun, and `steepness` the tangent of its elevation."""
    # Sunlight at (x, y) is blocked if, for any k, the height k pixels towards the sun minus k * drop exceeds the height
    # at (x, y). The maximum over 2k pixels combines those over the first and the next k: eight passes reach 256 pixels.
    drop_cm = 100 * scene.metres_per_pixel * steepness
    blocking, steps = scene.height_cm, 1
    while steps * scene.metres_per_pixel < _MAX_SHADOW_M:
        shift = np.array([[1, 0, steps * towards_sun[0]], [0, 1, steps * towards_sun[1]]])
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        size = blocking.shape[::-1]
        farther: Array = cv2.warpAffine(blocking, shift, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        blocking = np.maximum(blocking, cv2.subtract(farther, np.array(steps * drop_cm), farther), out=farther)
        steps *= 2
    shadow = cv2.compare(blocking, cv2.add(scene.height_cm, np.array(25.0)), cv2.CMP_GT)
    return cv2.GaussianBlur(shadow, (5, 5), 0)


def _make_clouds(scene: Scene, cloud_frac: float, seed: int) -> Array:
    """Return the fraction of sunlight that clouds block, uint8 (H, W); 255 is all of it."""
    coarse = make_noise(np.random.default_rng(seed), (64, 64), 16, 3)
    edge = float(np.quantile(coarse, 1 - cloud_frac)) + (0.25 if cloud_frac == 0 else 0)
    cover = (150 * smooth_step(coarse, edge - 0.25, edge + 0.25)).astype(np.uint8)
    return cv2.resize(cover, scene.height_cm.shape[::-1], interpolation=cv2.INTER_CUBIC)


def project_view(pose: CameraPose, camera: Camera) -> Doubles | None:
    """Return the corners of the picture on the ground, (4, 2) metres east and north; None if it shows the horizon."""
    corners = [(0, 0, 1), (camera.width - 1, 0, 1), (camera.width - 1, camera.height - 1, 1), (0, camera.height - 1, 1)]
    ground = np.linalg.solve(ground_to_pixel(pose, camera), np.array(corners, float).T).T
    return ground[:, :2] / ground[:, 2:] if (ground[:, 2] > 0).all() else None  # inverse depth


def photograph(
    ground: np.ndarray,
    metres_per_pixel: float,
    pose: CameraPose,
    camera: Camera,
    light: Light,
    rng: np.random.Generator,
    border: int = cv2.BORDER_REFLECT,
) -> np.ndarray:
    """Take one frame, uint8 (camera.height, camera.width, 3) BGR, of ground from `light_scene`; `rng` generates the
    sensor noise. `border` is OpenCV's border mode beyond the ground: its mirror image, or black (BORDER_CONSTANT)."""
    # The centre of the north-west pixel lies half a pixel inside the scene.
    half, depth_m = metres_per_pixel / 2, len(ground) * metres_per_pixel
    metres_from_pixel = np.array([[metres_per_pixel, 0, half], [0, -metres_per_pixel, depth_m - half], [0, 0, 1]])
    view = ground_to_pixel(pose, camera) @ metres_from_pixel
    frame = cv2.warpPerspective(ground, view, (camera.width, camera.height), borderMode=border)
    if camera.blur_px >= 1:
        frame = cv2.blur(frame, (1, round(camera.blur_px) + 1))  # the ground moves down the picture
    tone = np.linspace(0, 1, 256, dtype=np.float32) ** light.gamma * light.exposure
    tone = tone * (1 - light.haze_frac) + 0.62 * light.haze_frac
    frame_levels: Array = cv2.LUT(frame, (255 * tone).astype(np.float32))
    frame_levels += camera.noise_sigma * rng.standard_normal((camera.height, camera.width, 1), np.float32)
    return np.clip(frame_levels, 0, 255).astype(np.uint8)
