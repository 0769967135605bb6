"""Cameras with distortion, by OpenCV's own models: what they take of flat ground, and their calibration files."""

from functools import cached_property

import cv2
import numpy as np

from edgevpr.lab.simulate.camera import Camera, CameraPose, ground_to_pixel

SIZE_PX = 640, 480
_OF_RAYS = Camera(width=1, height=1, focal_px=1.0)  # its pixels are rays


class DistortedCamera:
    """A camera of 640x480 pixels with the distortion `coefficients` of OpenCV's model (`fisheye`: of its fisheye's)."""

    def __init__(self, focal_px, coefficients, *, fisheye=False, centre_px=(319.5, 239.5), size_px=SIZE_PX):
        self.matrix = np.array([[focal_px, 0, centre_px[0]], [0, focal_px, centre_px[1]], [0, 0, 1]], float)
        self.coefficients, self.fisheye, self.size_px = np.array(coefficients, float), fisheye, size_px

    @cached_property
    def rays(self):
        """The ray of each pixel, as tangents to the right and down (H, W, 2), by OpenCV's inverse."""
        width, height = self.size_px
        pixels = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height)), axis=-1).reshape(-1, 1, 2)
        until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-10)
        if self.fisheye:
            rays = cv2.fisheye.undistortPoints(pixels, self.matrix, self.coefficients, criteria=until)
        elif hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
            rays = cv2.undistortPointsIter(pixels, self.matrix, self.coefficients, np.eye(3), np.eye(3), until)
        else:
            rays = cv2.undistortPoints(pixels, self.matrix, self.coefficients, criteria=until)
        return rays.reshape(height, width, 2)

    def photograph(self, ground, m_per_px, **pose):
        """What it takes of `ground`, a picture of which each pixel is `m_per_px` wide, north up."""
        depth_m, half = len(ground) * m_per_px, m_per_px / 2
        pixel_from_metres = np.linalg.inv([[m_per_px, 0, half], [0, -m_per_px, depth_m - half], [0, 0, 1]])
        ground_from_ray = pixel_from_metres @ np.linalg.inv(ground_to_pixel(CameraPose(**pose), _OF_RAYS))
        spots = cv2.perspectiveTransform(self.rays, ground_from_ray).astype(np.float32)
        return cv2.remap(ground, spots, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)

    def write(self, path):
        """Write its calibration, as OpenCV's program does, and return the path."""
        storage = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
        storage.write("image_width", self.size_px[0])
        storage.write("image_height", self.size_px[1])
        storage.write("fisheye_model", int(self.fisheye))
        storage.write("camera_matrix", self.matrix)
        storage.write("distortion_coefficients", self.coefficients.reshape(-1, 1))
        storage.release()
        return path


def make_wide_camera():
    """A wide-angle lens with barrel distortion, as of an action camera: 100 degrees across."""
    return DistortedCamera(352.0, (-0.3, 0.09, 0.0, 0.0), centre_px=(327.0, 233.0))


def make_fisheye_camera():
    """An equidistant fisheye of 140 degrees across."""
    return DistortedCamera(262.0, (0.02, -0.01, 0.003, -0.0005), fisheye=True, centre_px=(313.0, 244.0))
