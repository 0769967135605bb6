"""V4L2 cameras: opening one, and the cause if that fails."""

import errno
import fcntl
import os
from collections.abc import Callable

import cv2

from edgevpr.frames.live import DeviceCapture
from edgevpr.frames.shot import OpeningError

_CAUSES = {
    errno.ENOENT: "not connected",
    errno.ENXIO: "no driver for this device",
    errno.ENODEV: "no driver for this device",
    errno.EBUSY: "in use by another program",
    errno.EACCES: "not permitted for this user",
    errno.EPERM: "not permitted for this user",
}
_QUERY_CAPABILITIES = 0x80685600  # VIDIOC_QUERYCAP
_CAPABILITIES_BYTES = 104
_DEVICE_CAPABILITIES = slice(88, 92)
_VIDEO_CAPTURE = 0x1001  # of one plane, or of several


def open_device(path: str, clock: Callable[[], float]) -> DeviceCapture:
    """Open the V4L2 camera `path`. `clock` is the monotonic clock in seconds. Raises OpeningError with the cause."""
    capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
    if capture.isOpened():
        return DeviceCapture(capture, clock)
    capture.release()
    raise OpeningError(_explain(path))


def _explain(path: str) -> str:
    try:
        device = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except OSError as error:
        return _CAUSES.get(error.errno or 0, f"cannot be opened: {error.strerror}")
    capabilities = bytearray(_CAPABILITIES_BYTES)
    try:
        fcntl.ioctl(device, _QUERY_CAPABILITIES, capabilities)
    except OSError:
        return "no V4L2 camera"
    finally:
        os.close(device)
    if not int.from_bytes(capabilities[_DEVICE_CAPABILITIES], "little") & _VIDEO_CAPTURE:
        return "this node of the camera has no pictures: give another one of its /dev/video numbers"
    return "in use by another program, or in no format that OpenCV reads"
