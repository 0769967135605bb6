"""V4L2 cameras: opens one, or explains why that fails, and reads its images."""

import contextlib
import errno
import fcntl
import os
from collections.abc import Callable

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Image
from edgevpr.frames.age import UnstampedTime
from edgevpr.frames.depth import DepthRange, make_counts_thumbnail, to_8_bits
from edgevpr.frames.shot import Capture, OpeningError, Shot, make_thumbnail

_ERRNO_CAUSES = {
    errno.ENOENT: "not connected",
    errno.ENXIO: "no driver for this device",
    errno.ENODEV: "no driver for this device",
    errno.EBUSY: "in use by another program",
    errno.EACCES: "this user may not access it",
    errno.EPERM: "this user may not access it",
}
_QUERY_CAPABILITIES = 0x80685600  # VIDIOC_QUERYCAP
_CAPABILITIES_BYTES = 104
_DEVICE_CAPABILITIES = slice(88, 92)
_VIDEO_CAPTURE = 0x1001  # of one plane, or of several
_COUNT_FORMATS = [cv2.VideoWriter.fourcc(*name) for name in ("Y16 ", "Y12 ", "Y10 ")]  # of thermal cameras


def open_device(path: str, clock: Callable[[], float]) -> "DeviceCapture":
    """Open the V4L2 camera `path`. `clock` is the monotonic clock in seconds. Raises OpeningError with the cause."""
    capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
    if capture.isOpened():
        return DeviceCapture(capture, clock)
    capture.release()
    raise OpeningError(_find_cause(path))


def _find_cause(path: str) -> str:
    try:
        device = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except OSError as error:
        return _ERRNO_CAUSES.get(error.errno or 0, f"cannot be opened: {error.strerror}")
    capabilities = bytearray(_CAPABILITIES_BYTES)
    try:
        fcntl.ioctl(device, _QUERY_CAPABILITIES, capabilities)
    except OSError:
        return "not a V4L2 camera"
    finally:
        os.close(device)
    if not int.from_bytes(capabilities[_DEVICE_CAPABILITIES], "little") & _VIDEO_CAPTURE:
        return "this /dev/video node does not capture video: use another node of the same camera"
    return "in use by another program, or in a format that OpenCV cannot read"


class DeviceCapture(Capture):
    """A V4L2 camera opened with OpenCV, which does not report damaged images, so none is rejected. Its wait for an
    image cannot be interrupted, but times out (see `frames.images`)."""

    def __init__(self, capture: cv2.VideoCapture, clock: Callable[[], float]) -> None:
        self._capture, self._clock = capture, clock
        self._time, self._depth = UnstampedTime(clock()), DepthRange()
        if int(capture.get(cv2.CAP_PROP_FOURCC)) in _COUNT_FORMATS:
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # otherwise OpenCV keeps only the upper 8 bits

    def read(self) -> Shot | None:
        with contextlib.suppress(cv2.error):  # if an image cannot be converted, the source counts as lost
            request_s = self._clock()
            is_read, picture = self._capture.read()
            if is_read:
                arrival_s = self._clock()
                sd_s = self._time.estimate(request_s, arrival_s).sd_s
                thumbnail, convert = self._prepare(picture)
                return Shot(t_mono_s=arrival_s, t_sd_s=sd_s, thumbnail=thumbnail, convert=convert)
        return None

    def _prepare(self, picture: Array) -> tuple[Image, Callable[[], Image]]:
        """Return the coarse copy of an image, and a function that converts it to pixels."""
        if picture.dtype == np.uint16:
            counts = np.asarray(picture, np.uint16)
            limits = self._depth.update(counts)
            return make_counts_thumbnail(counts), lambda: to_8_bits(counts, limits)
        image: Image = np.asarray(picture, np.uint8)
        return make_thumbnail(image if image.ndim == 2 else image[:, :, 1]), lambda: image

    def release(self) -> None:
        self._capture.release()
