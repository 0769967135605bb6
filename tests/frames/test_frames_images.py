"""Image files that are right, and all the ways in which they can be wrong."""

import contextlib
import os
import random
import struct
import zlib

import cv2
import numpy as np
import photographs
import pytest

from edgevpr.core.errors import ImageError, SourceError
from edgevpr.frames.exif import read_exif
from edgevpr.frames.images import MAX_PIXELS, list_images, read_image

THUMBNAIL = photographs.encode_image(".jpg", photographs.draw_picture(24, 32))
JPEGS = {
    "baseline": photographs.encode_image(".jpg", photographs.draw_picture()),
    "progressive": photographs.encode_image(".jpg", photographs.draw_picture(), cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restart markers": photographs.encode_image(".jpg", photographs.draw_picture(), cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
}
JPEGS["thumbnail"] = photographs.insert_app1(JPEGS["baseline"], b"not even TIFF" + THUMBNAIL)


def write(path, data):
    path.write_bytes(data)
    return path


def read_refusal(path):
    with pytest.raises(ImageError) as refusal:
        read_image(path)
    sentence = str(refusal.value)
    assert str(path) in sentence
    assert sentence.endswith(".")
    return sentence


@pytest.mark.parametrize("extension", [".jpg", ".png", ".tif", ".bmp", ".webp", ".ppm"])
def test_read_image_gives_bgr_of_each_format(extension, tmp_path):
    blue = np.zeros((20, 30, 3), np.uint8)
    blue[..., 0] = 200
    image = read_image(write(tmp_path / f"blue{extension}", photographs.encode_image(extension, blue)))
    assert image.dtype == np.uint8
    assert image.shape == (20, 30, 3)
    np.testing.assert_allclose(image.mean((0, 1)), (200, 0, 0), atol=3)


@pytest.mark.parametrize("kind", JPEGS)
def test_read_image_allows_bytes_behind_the_end_of_a_jpeg(kind, tmp_path):
    whole = read_image(write(tmp_path / "a.jpg", JPEGS[kind]))
    with_more = read_image(write(tmp_path / "b.jpg", JPEGS[kind] + bytes(100) + THUMBNAIL[:50]))
    np.testing.assert_array_equal(whole, with_more)


WHOLE = [(".jpg", data) for data in JPEGS.values()] + [
    (extension, photographs.encode_image(extension, photographs.draw_picture()))
    for extension in (".png", ".tif", ".bmp", ".webp", ".ppm")
]


@pytest.mark.parametrize(("extension", "whole"), WHOLE)
def test_read_image_refuses_a_truncated_image(extension, whole, tmp_path, capfd):
    for share in (0.02, 0.2, 0.5, 0.9, 0.995):
        sentence = read_refusal(write(tmp_path / f"cut{extension}", whole[: int(share * len(whole))]))
        assert "truncated" in sentence or extension not in (".jpg", ".png")
    assert capfd.readouterr().err == ""


PNG = dict(WHOLE)[".png"]
BASELINE = JPEGS["baseline"]


DAMAGED = "truncated or damaged"


def make_png(width, height):
    """A PNG whose header promises width x height, with every checksum right."""

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def make_tiff(**tags):
    """A little-endian TIFF of tags only, each one LONG."""
    entries = b"".join(struct.pack("<HHII", int(tag[1:]), 4, 1, value) for tag, value in sorted(tags.items()))
    return b"II*\x00\x08\x00\x00\x00" + struct.pack("<H", len(tags)) + entries + bytes(4)


def make_wide_jpeg():
    at = BASELINE.index(b"\xff\xc0") + 5
    return BASELINE[:at] + struct.pack(">HH", 65_000, 65_000) + BASELINE[at + 4 :]


TOO_MANY_PIXELS = "102 megapixels"


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        # What a card holds when the power went while the camera was writing.
        ("zeros.jpg", BASELINE[: len(BASELINE) // 2] + bytes(len(BASELINE) // 2), DAMAGED),
        ("bit.png", PNG[: len(PNG) // 2] + bytes([PNG[len(PNG) // 2] ^ 1]) + PNG[len(PNG) // 2 + 1 :], DAMAGED),
        *(("end.png", PNG[:-missing], DAMAGED) for missing in (1, 4, 8, 12, 13)),
        ("empty.jpg", b"", "is empty"),
        ("text.jpg", b"To whom it may concern: this is no photograph.", "not an image"),
        ("video.png", b"\x00\x00\x00\x20ftypisom" + bytes(100), "not an image"),
        ("deep.tif", photographs.encode_image(".tif", np.zeros((20, 20), np.int16)), "8 or 16 bits"),
        ("real.tif", photographs.encode_image(".tif", np.zeros((20, 20, 3), np.float32)), "8 or 16 bits"),
        ("flat.png", photographs.encode_image(".png", np.zeros((15, 40), np.uint8)), "40x15 pixels"),
        ("thin.png", photographs.encode_image(".png", np.zeros((40, 15), np.uint8)), "15x40 pixels"),
        ("wide.png", make_png(20_000, 20_000), TOO_MANY_PIXELS),
        ("wide.jpg", make_wide_jpeg(), TOO_MANY_PIXELS),
        ("wide.tif", make_tiff(t256=30_000, t257=30_000), TOO_MANY_PIXELS),
        ("tile.tif", make_tiff(t256=20, t257=20, t322=30_000, t323=30_000), TOO_MANY_PIXELS),
        ("wide.bmp", b"BM" + bytes(12) + struct.pack("<Iii", 40, 60_000, -60_000) + bytes(40), TOO_MANY_PIXELS),
        ("wide.webp", b"RIFF\x00\x00\x00\x00WEBPVP8X" + bytes(8) + b"\xff\xff\x00\xff\xff\x00", TOO_MANY_PIXELS),
        ("wide.pgm", b"P5\n60000 60000\n255\n" + bytes(100), TOO_MANY_PIXELS),
    ],
)
def test_read_image_refuses_damaged_too_large_and_other_files(name, content, what, tmp_path, capfd):
    assert what in read_refusal(write(tmp_path / name, content))
    assert capfd.readouterr().err == ""


def test_read_image_refuses_pipes_and_devices_at_once(tmp_path):
    read_refusal(tmp_path / "nothing.jpg")
    (tmp_path / "folder.jpg").mkdir()
    assert "a directory" in read_refusal(tmp_path / "folder.jpg")
    os.mkfifo(tmp_path / "a.jpg")
    assert "pipe" in read_refusal(tmp_path / "a.jpg")
    assert "device" in read_refusal("/dev/zero")


def test_list_images_sorts_as_a_person_counts(tmp_path):
    for name in ("IMG_10.jpg", "IMG_9.JPG", "img_2.Png", "a.tif", "notes.txt", "positions.csv", "._IMG_9.JPG"):
        (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["a.tif", "img_2.Png", "IMG_9.JPG", "IMG_10.jpg"]


def test_list_images_refuses_a_folder_without_images_and_names_subfolders_with_images(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(SourceError, match="nowhere"):
        list_images(tmp_path / "nowhere")
    with pytest.raises(SourceError, match="Not a directory"):
        list_images(tmp_path / "notes.txt")
    for name in ("day_10/IMG_1.jpg", "day_2/IMG_1.jpg", "notes/._IMG_1.jpg"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    with pytest.raises(SourceError, match=r"\(\.jpg") as refused:
        list_images(tmp_path)
    assert str(refused.value).endswith(f" {tmp_path}/day_2 or {tmp_path}/day_10.")


def make_files(folder):
    """Pairs of a picture file with all that a camera writes and the number of its first bytes that matter."""
    photographs.write_jpeg(
        folder / "photo.jpg",
        {1: "N", 2: (46.0, 50.0, 33.0), 3: "W", 4: (91.0, 59.0, 42.0), 6: 198.5, 7: (16.0, 31.0, 59.5), 17: 10.0},
        {0x9003: "2016:06:23 16:31:59"},
    )
    photo = (folder / "photo.jpg").read_bytes()
    xmp = b'<x drone-dji:RelativeAltitude="40" drone-dji:FlightYawDegree="+10.0"/>'
    yield photo, 4 + int.from_bytes(photo[4:6], "big")
    yield photographs.insert_app1(photo, xmp), 100
    for extension in (".jpg", ".png", ".tif", ".bmp", ".webp", ".ppm"):
        yield photographs.encode_image(extension, photographs.draw_picture()), 64


@pytest.mark.slow
def test_read_image_accepts_or_refuses_damaged_files_and_gives_only_valid_positions(tmp_path):
    chance, path = random.Random(5), tmp_path / "broken.jpg"
    for whole, most in make_files(tmp_path):
        for _ in range(100):
            broken = bytearray(whole[: chance.choice((len(whole), chance.randrange(len(whole))))])
            for _ in range(min(len(broken), chance.choice((1, 4, 16)))):
                broken[chance.randrange(min(len(broken), most))] = chance.choice((0, 255, chance.randrange(256)))
            path.write_bytes(broken)
            with contextlib.suppress(ImageError):
                assert read_image(path).size <= 3 * MAX_PIXELS
            tag = read_exif(path)
            assert tag.position is None or (abs(tag.position.lat_deg) <= 90 and abs(tag.position.lon_deg) <= 180)
            assert tag.heading_deg is None or 0 <= tag.heading_deg < 360
            assert tag.height_m is None or abs(tag.height_m) <= 100_000
