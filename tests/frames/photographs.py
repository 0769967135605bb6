"""Image files as cameras write them, made for a test."""

import cv2
import numpy as np


def draw_picture(height: int = 48, width: int = 64) -> np.ndarray:
    """A picture (height, width, 3) with enough in it for a JPEG of some kilobytes; always the same."""
    noise = np.random.default_rng(7).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 1.0)


def encode_image(extension: str, image: np.ndarray, *options: int) -> bytes:
    return cv2.imencode(extension, image, options)[1].tobytes()


def insert_app1(jpeg: bytes, content: bytes, head: bytes = b"Exif\x00\x00") -> bytes:
    """The JPEG with `content` as its EXIF segment, or as that of another `head`, right or wrong."""
    payload = head + content
    return jpeg[:2] + b"\xff\xe1" + (len(payload) + 2).to_bytes(2, "big") + payload + jpeg[2:]


def write_jpeg(path, gps: dict | None = None, camera: dict | None = None, image: dict | None = None) -> None:
    """Write a JPEG with EXIF tags by number: of the GPS, of the camera (Exif IFD) and of the image (IFD 0)."""
    from PIL import Image

    exif = Image.Exif()
    exif.update(image or {})
    exif.get_ifd(0x8825).update(gps or {})
    exif.get_ifd(0x8769).update(camera or {})
    Image.fromarray(draw_picture()).save(path, "JPEG", exif=exif)
