"""Image files that are right, and all the ways in which they can be wrong."""

import contextlib
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

from edgevpr.core.errors import ImageError, SourceError
from edgevpr.frames.exif import read_exif
from edgevpr.frames.images import MAX_PIXELS, list_images, read_image

THUMBNAIL = photographs.encoded(".jpg", photographs.picture(24, 32))
JPEGS = {
    "baseline": photographs.encoded(".jpg", photographs.picture()),
    "progressive": photographs.encoded(".jpg", photographs.picture(), cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restart markers": photographs.encoded(".jpg", photographs.picture(), cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
}
JPEGS["thumbnail"] = photographs.with_app1(JPEGS["baseline"], b"not even TIFF" + THUMBNAIL)


def write(path, data):
    path.write_bytes(data)
    return path


def complaint(path):
    with pytest.raises(ImageError) as refusal:
        read_image(path)
    sentence = str(refusal.value)
    assert str(path) in sentence
    assert sentence.endswith(".")
    return sentence


@pytest.mark.parametrize("extension", [".jpg", ".png", ".tif", ".bmp", ".webp", ".ppm"])
def test_a_colour_image_of_each_format_is_read_as_bgr(extension, tmp_path):
    blue = np.zeros((20, 30, 3), np.uint8)
    blue[..., 0] = 200
    image = read_image(write(tmp_path / f"blue{extension}", photographs.encoded(extension, blue)))
    assert image.dtype == np.uint8
    assert image.shape == (20, 30, 3)
    np.testing.assert_allclose(image.mean((0, 1)), (200, 0, 0), atol=3)


@pytest.mark.parametrize("kind", JPEGS)
def test_a_whole_jpeg_is_read_also_with_bytes_behind_its_end(kind, tmp_path):
    whole = read_image(write(tmp_path / "a.jpg", JPEGS[kind]))
    with_more = read_image(write(tmp_path / "b.jpg", JPEGS[kind] + bytes(100) + THUMBNAIL[:50]))
    np.testing.assert_array_equal(whole, with_more)


@pytest.mark.parametrize("kind", JPEGS)
@pytest.mark.parametrize("share", [0.05, 0.5, 0.99, 1.0])
def test_a_truncated_jpeg_is_refused(kind, share, tmp_path, capfd):
    cut = JPEGS[kind][: int(share * len(JPEGS[kind])) - 1]
    assert "cut short" in complaint(write(tmp_path / "cut.jpg", cut))
    assert capfd.readouterr().err == ""


def test_a_jpeg_that_ends_in_zeros_is_refused(tmp_path):
    """What a card holds when the power went while the camera was writing."""
    half = len(JPEGS["baseline"]) // 2
    assert "cut short" in complaint(write(tmp_path / "zeros.jpg", JPEGS["baseline"][:half] + bytes(half)))


@pytest.mark.parametrize("extension", [".png", ".tif", ".bmp", ".webp", ".ppm"])
@pytest.mark.parametrize("share", [0.02, 0.2, 0.5, 0.9, 0.995])
def test_a_truncated_image_of_another_format_is_refused(extension, share, tmp_path, capfd):
    whole = photographs.encoded(extension, photographs.picture())
    complaint(write(tmp_path / f"cut{extension}", whole[: int(share * len(whole))]))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("missing", [1, 4, 8, 12, 13])
def test_a_png_without_its_last_bytes_or_with_a_wrong_bit_is_refused(missing, tmp_path, capfd):
    png = bytearray(photographs.encoded(".png", photographs.picture()))
    assert "cut short" in complaint(write(tmp_path / "cut.png", png[:-missing]))
    png[len(png) // 2] ^= 1
    assert "damaged" in complaint(write(tmp_path / "bit.png", png))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("empty.jpg", b"", "is empty"),
        ("text.jpg", b"To whom it may concern: this is no photograph.", "is not an image"),
        ("video.png", b"\x00\x00\x00\x20ftypisom" + bytes(100), "is not an image"),
        ("deep.tif", photographs.encoded(".tif", np.zeros((20, 20), np.int16)), "8 or 16 bits"),
        ("real.tif", photographs.encoded(".tif", np.zeros((20, 20, 3), np.float32)), "8 or 16 bits"),
        ("flat.png", photographs.encoded(".png", np.zeros((15, 40), np.uint8)), "40x15 pixels"),
        ("thin.png", photographs.encoded(".png", np.zeros((40, 15), np.uint8)), "15x40 pixels"),
    ],
)
def test_a_file_that_is_no_image_or_another_one_than_is_read_is_refused(name, content, what, tmp_path, capfd):
    assert what in complaint(write(tmp_path / name, content))
    assert capfd.readouterr().err == ""


def test_an_image_that_does_not_fit_in_memory_is_refused_like_any_other(tmp_path, monkeypatch):
    def full(*_):
        raise MemoryError

    monkeypatch.setattr("edgevpr.frames.images.read_file", full)
    assert "memory" in complaint(tmp_path / "large.tif")


def test_a_missing_image_a_folder_a_pipe_and_a_device_are_refused_and_not_waited_for(tmp_path):
    complaint(tmp_path / "nothing.jpg")
    (tmp_path / "folder.jpg").mkdir()
    assert "a directory" in complaint(tmp_path / "folder.jpg")
    os.mkfifo(tmp_path / "a.jpg")
    assert "pipe" in complaint(tmp_path / "a.jpg")
    assert "device" in complaint("/dev/zero")


def test_images_are_listed_as_a_person_counts(tmp_path):
    for name in ("IMG_10.jpg", "IMG_9.JPG", "img_2.Png", "a.tif", "notes.txt", "positions.csv", "._IMG_9.JPG"):
        (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["a.tif", "img_2.Png", "IMG_9.JPG", "IMG_10.jpg"]


def test_a_folder_without_images_is_refused(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(SourceError, match=r"\(\.jpg"):
        list_images(tmp_path)
    with pytest.raises(SourceError, match="nowhere"):
        list_images(tmp_path / "nowhere")
    with pytest.raises(SourceError, match="listed"):
        list_images(tmp_path / "notes.txt")


def test_where_the_images_lie_in_a_folder_inside_that_one_is_named(tmp_path):
    for name in ("notes", "day_2", "day_10"):
        (tmp_path / name).mkdir()
    (tmp_path / "notes" / "._IMG_1.jpg").touch()
    for name in ("day_10", "day_2"):
        (tmp_path / name / "IMG_1.jpg").touch()
    with pytest.raises(SourceError) as refused:
        list_images(tmp_path)
    assert str(refused.value).endswith(f" {tmp_path}/day_2 or {tmp_path}/day_10.")


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
    with pytest.raises(ImageError, match=f"{name}.*102 megapixels"):
        read_image(tmp_path / name)
    assert capfd.readouterr().err == ""


@pytest.mark.process
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


def whole_files(folder):
    """Pairs of a picture file with all that a camera writes and the number of its first bytes that matter."""
    photographs.write_jpeg(
        folder / "photo.jpg",
        {1: "N", 2: (46.0, 50.0, 33.0), 3: "W", 4: (91.0, 59.0, 42.0), 6: 198.5, 7: (16.0, 31.0, 59.5), 17: 10.0},
        {0x9003: "2016:06:23 16:31:59"},
    )
    photo = (folder / "photo.jpg").read_bytes()
    xmp = b'<x drone-dji:RelativeAltitude="40" drone-dji:FlightYawDegree="+10.0"/>'
    yield photo, 4 + int.from_bytes(photo[4:6], "big")
    yield photographs.with_app1(photo, xmp), 100
    for extension in (".jpg", ".png", ".tif", ".bmp", ".webp", ".ppm"):
        yield photographs.encoded(extension, photographs.picture()), 64


@pytest.mark.slow
def test_a_file_with_bytes_gone_wrong_is_read_or_refused_and_its_tags_never_leave_the_earth(tmp_path):
    chance, path = random.Random(5), tmp_path / "broken.jpg"
    for whole, most in whole_files(tmp_path):
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
