"""The header of an image file, as real encoders write it, and as a hostile user does."""

import os
import random
import resource
import struct
import subprocess
import sys
import zlib

import cv2
import photographs
import pytest

from edgevpr.core.errors import ImageError
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


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("wide.png", png(20_000, 20_000)),
        ("wide.jpg", photographs.encoded(".jpg", photographs.picture())),
        ("wide.tif", tiff(t256=30_000, t257=30_000)),
        ("tile.tif", tiff(t256=20, t257=20, t322=30_000, t323=30_000)),
        ("wide.bmp", b"BM" + bytes(12) + struct.pack("<Iii", 40, 60_000, -60_000) + bytes(40)),
        ("wide.webp", b"RIFF\x00\x00\x00\x00WEBPVP8X" + bytes(8) + b"\xff\xff\x00\xff\xff\x00"),
        ("wide.pgm", b"P5\n60000 60000\n255\n" + bytes(100)),
    ],
)
def test_a_picture_of_too_many_pixels_is_refused_by_its_header(name, content, tmp_path, capfd):
    if name == "wide.jpg":
        at = content.index(b"\xff\xc0") + 5
        content = content[:at] + struct.pack(">HH", 65_000, 65_000) + content[at + 4 :]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ImageError, match=f"{name}.*(102 megapixels|decode)"):
        read_image(tmp_path / name)
    assert capfd.readouterr().err == ""


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
    assert "102 megapixels" in done.stdout, done.stderr


def test_a_header_with_bytes_gone_wrong_is_read_or_refused(tmp_path):
    chance = random.Random(5)

    def read_image_of(content):
        (tmp_path / "broken.jpg").write_bytes(content)
        return read_image(tmp_path / "broken.jpg")

    for extension, options in FORMATS.items():
        whole = photographs.encoded(extension, photographs.picture(), *options)
        for _ in range(300):
            broken = bytearray(whole[: chance.choice((len(whole), chance.randrange(len(whole))))])
            for _ in range(min(len(broken), chance.choice((1, 4, 16)))):
                broken[chance.randrange(min(len(broken), 64))] = chance.choice((0, 255, chance.randrange(256)))
            try:
                assert read_image_of(bytes(broken)).size <= 3 * MAX_PIXELS
            except ImageError:
                continue


def test_a_pipe_named_like_an_image_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.jpg")
    with pytest.raises(ImageError, match=r"a\.jpg.*pipe"):
        read_image(tmp_path / "a.jpg")
    with pytest.raises(ImageError, match="device"):
        read_image("/dev/zero")


def test_a_jpeg_of_hundreds_of_scans_is_refused(tmp_path):
    jpeg = photographs.encoded(".jpg", photographs.picture(), cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    at = jpeg.rindex(b"\xff\xda")
    (tmp_path / "scans.jpg").write_bytes(jpeg[:at] + jpeg[at:-2] * 200 + jpeg[-2:])
    with pytest.raises(ImageError, match="damaged"):
        read_image(tmp_path / "scans.jpg")
