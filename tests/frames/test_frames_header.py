"""The header of an image file, as real encoders write it, and as a hostile user does."""

import io
import os
import random
import resource
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import photographs
import pytest

from edgevpr.core.errors import ImageError
from edgevpr.frames.header import Header, read_header
from edgevpr.frames.images import MAX_PIXELS, read_image

FORMATS = {
    ".jpg": (),
    ".png": (),
    ".tif": (),
    ".bmp": (),
    ".webp": (cv2.IMWRITE_WEBP_QUALITY, 80),
    ".ppm": (),
}


def png(width, height, rows=b""):
    """A PNG whose header promises width x height, with every checksum right."""

    def chunk(kind, content):
        checksum = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def tiff(**tags):
    """A little-endian TIFF of tags only, each one LONG."""
    entries = b"".join(struct.pack("<HHII", int(tag[1:]), 4, 1, value) for tag, value in sorted(tags.items()))
    return b"II*\x00\x08\x00\x00\x00" + struct.pack("<H", len(tags)) + entries + bytes(4)


@pytest.mark.parametrize("extension", FORMATS)
def test_the_size_is_that_of_the_decoded_picture(extension):
    content = photographs.encoded(extension, photographs.picture(50, 83), *FORMATS[extension])
    assert read_header(content) == Header(83, 50)


@pytest.mark.parametrize(
    "options",
    [
        {"format": "WEBP", "lossless": True},
        {"format": "WEBP", "exif": b"Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x00"},
        {"format": "JPEG", "progressive": True},
        {"format": "TIFF", "compression": "tiff_lzw"},
        {"format": "TIFF", "big_tiff": True},
    ],
)
def test_the_size_is_right_in_the_other_forms_of_a_format(options):
    image = pytest.importorskip("PIL.Image").fromarray(photographs.picture(50, 83))
    image.save(content := io.BytesIO(), **options)
    assert read_header(content.getvalue()) == Header(83, 50)


def test_the_depth_is_known_before_the_pixels():
    deep = np.zeros((20, 30), np.uint16)
    for extension in (".png", ".tif", ".pgm"):
        assert read_header(photographs.encoded(extension, deep)) == Header(30, 20, 16)
    deep_colour = np.zeros((20, 30, 3), np.uint16)  # whose depths lie elsewhere in a TIFF
    assert read_header(photographs.encoded(".tif", deep_colour)) == Header(30, 20, 16)


def test_a_thumbnail_in_the_exif_is_not_taken_for_the_picture():
    thumbnail = photographs.encoded(".jpg", photographs.picture(16, 16))
    jpeg = photographs.encoded(".jpg", photographs.picture(50, 83))
    assert read_header(photographs.with_app1(jpeg, thumbnail)) == Header(83, 50)


@pytest.mark.parametrize(
    ("name", "content", "promised"),
    [
        ("wide.png", png(20_000, 20_000), "20000x20000"),
        ("wide.jpg", photographs.encoded(".jpg", photographs.picture()), "65000x65000"),
        ("wide.tif", tiff(t256=30_000, t257=30_000), "30000x30000"),
        ("tile.tif", tiff(t256=20, t257=20, t322=30_000, t323=30_000), "30000x30000"),
        ("wide.bmp", b"BM" + bytes(12) + struct.pack("<Iii", 40, 60_000, -60_000) + bytes(40), "60000x60000"),
        ("wide.webp", b"RIFF\x00\x00\x00\x00WEBPVP8X" + bytes(8) + b"\xff\xff\x00\xff\xff\x00", "65536x65536"),
    ],
)
def test_a_picture_of_too_many_pixels_is_refused_by_its_header(name, content, promised, tmp_path):
    if name == "wide.jpg":
        at = content.index(b"\xff\xc0") + 5
        content = content[:at] + struct.pack(">HH", 65_000, 65_000) + content[at + 4 :]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ImageError, match=f"{name} is {promised} pixels; edgevpr reads up to 102 megapixels"):
        read_image(tmp_path / name)


def test_the_picture_of_the_largest_camera_is_not_refused():
    assert read_header(png(11_664, 8_750)).width * 8_750 <= MAX_PIXELS


def test_a_small_file_does_not_take_gigabytes(tmp_path):
    side = 20_000
    (tmp_path / "bomb.png").write_bytes(png(side, side, bytes(side + 1) * side))
    assert (tmp_path / "bomb.png").stat().st_size < 1_300_000
    code = (
        "import sys\nfrom edgevpr.core.errors import ImageError\nfrom edgevpr.frames.images import read_image\n"
        "try:\n    read_image(sys.argv[1])\nexcept ImageError as error:\n    print(error)"
    )

    def limit():
        resource.setrlimit(resource.RLIMIT_AS, (2_000_000_000, 2_000_000_000))

    argv = [sys.executable, "-c", code, tmp_path / "bomb.png"]
    done = subprocess.run(argv, capture_output=True, text=True, preexec_fn=limit, timeout=60)
    assert "20000x20000 pixels" in done.stdout, done.stderr


def test_a_header_with_bytes_gone_wrong_never_raises():
    chance = random.Random(5)
    for extension, options in FORMATS.items():
        whole = photographs.encoded(extension, photographs.picture(), *options)
        for _ in range(300):
            broken = bytearray(whole[: chance.choice((len(whole), chance.randrange(len(whole))))])
            for _ in range(min(len(broken), chance.choice((1, 4, 16)))):
                broken[chance.randrange(min(len(broken), 64))] = chance.choice((0, 255, chance.randrange(256)))
            found = read_header(bytes(broken))
            assert found is None or found.width >= 0


def test_a_pipe_named_like_an_image_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.jpg")
    with pytest.raises(ImageError, match=r"a\.jpg cannot be read \(it is a pipe or a device and not a regular file\)"):
        read_image(tmp_path / "a.jpg")
    with pytest.raises(ImageError, match="not a regular file"):
        read_image("/dev/zero")


def test_a_jpeg_of_hundreds_of_scans_is_refused(tmp_path):
    jpeg = photographs.encoded(".jpg", photographs.picture(), cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    at = jpeg.rindex(b"\xff\xda")
    (tmp_path / "scans.jpg").write_bytes(jpeg[:at] + jpeg[at:-2] * 200 + jpeg[-2:])
    with pytest.raises(ImageError, match="damaged"):
        read_image(tmp_path / "scans.jpg")
