"""Pixel formats of streams, videos and images: depth, range and shape of the pixels, and converters of two threads."""

import contextlib
import itertools
import threading
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import psutil
import pytest

from edgevpr.core.errors import ImageError
from edgevpr.frames.decoding import VideoDecoder, open_decoder
from edgevpr.frames.depth import DepthRange
from edgevpr.frames.devices import DeviceCapture
from edgevpr.frames.images import read_image
from edgevpr.frames.source import open_source, read_to_end
from edgevpr.frames.stereo import StereoCheck

SIZE_PX = (256, 64)
RAMP = np.repeat(np.arange(256, dtype=np.uint8)[None, :], SIZE_PX[1], 0)
SCENE = cv2.GaussianBlur(np.random.default_rng(3).normal(128, 400, (240, 320)), (0, 0), 3)
MAX_LEVEL_ERROR = 5  # levels: FFmpeg's fast conversion of yuv420p, which is as exact as flights and maps ever were


def write_video(path: Path, pictures, pixel_format: str, codec: str = "ffv1", **settings) -> Path:
    """Write frames of PyAV, or pictures uint8 (H, W, 3) BGR; `settings` are of the stream or of its codec."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=settings.pop("options", {}))
        for index, picture in enumerate(pictures):
            frame = picture
            if isinstance(picture, np.ndarray):
                frame = av.VideoFrame.from_ndarray(picture, "bgr24").reformat(format=pixel_format)
            if not index:
                stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, pixel_format
                for name, value in settings.items():
                    setattr(stream.codec_context, name, value)
            frame.pts = index
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def read_frames(path: Path) -> list[np.ndarray]:
    return [frame.image for frame in read_to_end(open_source(str(path), live=False), pytest.fail) if frame]


def to_counts(grey: np.ndarray, counts_per_level: float = 4, black: int = 7600) -> np.ndarray:
    """Turn a picture into what a thermal camera gives: a thousand counts somewhere in the middle of 16 bits."""
    return (black + counts_per_level * np.clip(grey, 0, 255)).astype(np.uint16)


def make_thermal_flight() -> list[np.ndarray]:
    return [to_counts(np.roll(SCENE, 8 * step, 1)) for step in range(12)]


def decode_file(path: Path) -> tuple[VideoDecoder, list[av.VideoFrame]]:
    whole = open_decoder(str(path), {})
    return whole, [picture for fetched in iter(whole.fetch, None) for picture in whole.decode(fetched)]


@pytest.mark.slow
@pytest.mark.parametrize("pixel_format", ["yuv420p10le", "yuyv422", "gray16le"])
def test_make_thumbnail_is_safe_in_two_threads(pixel_format, tmp_path):
    """Two threads in one converter of FFmpeg hang or crash, and take memory without end."""
    codec = "rawvideo" if pixel_format == "yuyv422" else "ffv1"
    whole, pictures = decode_file(write_video(tmp_path / "a.nut", [cv2.merge([RAMP] * 3)] * 8, pixel_format, codec))
    finished = []

    def convert() -> None:
        for picture in itertools.islice(itertools.cycle(pictures), 400):
            whole.make_thumbnail(picture)
            whole.prepare_conversion(picture)()
        finished.append(True)

    before_mb = psutil.Process().memory_info().rss / 1e6
    threads = [threading.Thread(target=convert, daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert len(finished) == 3
    assert psutil.Process().memory_info().rss / 1e6 - before_mb < 50


@pytest.mark.parametrize(
    ("pixel_format", "codec", "color_range", "levels"),
    [
        ("yuv420p", "libx264", 1, MAX_LEVEL_ERROR),
        ("yuv420p", "libx264", 2, 2),
        ("yuv420p", "libx265", 2, 2),
        ("yuv422p", "libx264", 1, 2),
        ("yuv422p", "libx264", 2, 2),
        ("yuv420p10le", "libx264", 1, 2),
        ("yuv420p10le", "libx264", 2, 2),
        ("yuv422p10le", "ffv1", 1, 2),
        ("yuv420p12le", "rawvideo", 1, 2),
        ("nv12", "rawvideo", 1, 2),
        ("yuyv422", "rawvideo", 1, 2),
        ("gray", "ffv1", 0, 0),
        ("yuvj422p", "mjpeg", 2, 3),
    ],
)
def test_read_frames_keeps_a_grey_ramp_in_each_format(pixel_format, codec, color_range, levels, tmp_path):
    frame = av.VideoFrame.from_ndarray(cv2.merge([RAMP] * 3), "bgr24")
    frame = frame.reformat(format=pixel_format, src_color_range=2, dst_color_range=color_range)
    options = {"libx264": {"qp": "1"}, "libx265": {"crf": "4", "x265-params": "log-level=none"}}.get(codec, {})
    quality = {"qmin": 1, "qmax": 1} if codec == "mjpeg" else {}
    settings = {"options": options, "color_range": color_range, **quality}
    (image,) = read_frames(write_video(tmp_path / "ramp.nut", [frame], pixel_format, codec, **settings))
    assert np.abs(image[SIZE_PX[1] // 2].astype(int) - RAMP[0][:, None]).max() <= levels


def test_read_frames_gives_equal_counts_from_a_folder_and_a_video(tmp_path):
    flight = make_thermal_flight()
    for index, counts in enumerate(flight):
        cv2.imwrite(str(tmp_path / f"{index}{('.png', '.tif')[index % 2]}"), counts)
    images = read_frames(tmp_path)
    assert all(image.std() > 50 for image in images)
    for form in ("gray16le", "gray16be"):
        video = [av.VideoFrame.from_ndarray(counts, "gray16le").reformat(format=form) for counts in flight]
        path = write_video(tmp_path / f"{form}.nut", video, form, "rawvideo")
        assert all((image == frame).all() for image, frame in zip(images, read_frames(path), strict=True))


def test_video_of_12_bits_of_grey_shows_its_own_range_with_square_pixels(tmp_path):
    counts = to_counts(SCENE, 32, 16_000)  # 16 times the counts of 12 bits
    video = [av.VideoFrame.from_ndarray(counts, "gray16le").reformat(format="gray12le")]
    settings = {"options": {"x265-params": "log-level=none:lossless=1"}, "sample_aspect_ratio": Fraction(3, 2)}
    (image,) = read_frames(write_video(tmp_path / "a.mkv", video, "gray12le", "libx265", **settings))
    assert image.std() > 50
    assert image.shape == (240, 480)


def test_depth_range_is_common_to_all_channels_of_a_16_bit_colour_image(tmp_path):
    cv2.imwrite(str(tmp_path / "colour.png"), cv2.merge([to_counts(SCENE), to_counts(SCENE), to_counts(SCENE, 2)]))
    colour = read_image(tmp_path / "colour.png")
    assert (colour.dtype, colour.shape) == (np.uint8, (*SCENE.shape, 3))
    assert colour[..., 0].mean() > colour[..., 2].mean() + 20


def test_depth_range_keeps_ground_levels_while_a_hot_object_passes():
    depth = DepthRange()
    before, *_ = (depth.to_8_bits(counts) for counts in make_thermal_flight())
    with_fire = make_thermal_flight()[0]
    with_fire[:, :40] = 20_000  # an eighth of the picture
    for _ in range(2):
        shown = depth.to_8_bits(with_fire)
    assert (shown[:, :40] == 255).all()
    assert shown[:, 40:].std() > 0.3 * before[:, 40:].std()


def test_depth_range_shows_an_image_outside_the_range_with_its_own_range():
    depth = DepthRange()
    flight = make_thermal_flight()
    first, *_ = (depth.to_8_bits(counts) for counts in flight)
    moved = depth.to_8_bits(flight[0] + np.uint16(3000))  # as after the calibration of a thermal camera's shutter
    assert np.abs(first.astype(int) - moved).mean() < 12
    assert depth.to_8_bits(to_counts(SCENE, 0.5)).std() > 0.8 * first.std()


def test_depth_range_does_not_amplify_noise_without_a_scene():
    noise = np.random.default_rng(1).normal(8000, 2, (240, 320)).astype(np.uint16)
    assert DepthRange().to_8_bits(noise).std() < 12
    for count in (0, 65535):
        assert DepthRange().to_8_bits(np.full((240, 320), count, np.uint16)).std() == 0


def test_coarse_copies_of_a_frozen_16_bit_image_are_equal(tmp_path):
    flight = [*make_thermal_flight(), *[make_thermal_flight()[3]] * 3]
    video = [av.VideoFrame.from_ndarray(counts, "gray16le") for counts in flight]
    whole, pictures = decode_file(write_video(tmp_path / "a.nut", video, "gray16le"))
    looks = [whole.make_thumbnail(picture) for picture in pictures]
    assert (looks[-1] == looks[-2]).all()
    assert np.abs(looks[0].astype(int) - looks[1]).mean() > 3


class ThermalCamera:
    """A V4L2 camera of 16 bits, which OpenCV cuts down to 8 unless it is told not to."""

    converts = True

    def __init__(self, pictures) -> None:
        self._pictures = iter(pictures)

    def get(self, prop: int) -> float:
        return float(cv2.VideoWriter.fourcc(*"Y16 ")) if prop == cv2.CAP_PROP_FOURCC else 0.0

    def set(self, prop: int, value: float) -> None:
        self.converts = self.converts and prop != cv2.CAP_PROP_CONVERT_RGB

    def read(self):
        counts = next(self._pictures)
        return True, cv2.merge([(counts >> 8).astype(np.uint8)] * 3) if self.converts else counts


def test_v4l2_16_bit_camera_gives_the_same_images_as_a_folder(tmp_path):
    for index, counts in enumerate(make_thermal_flight()):
        cv2.imwrite(str(tmp_path / f"{index}.png"), counts)
    capture = DeviceCapture(ThermalCamera(make_thermal_flight()), clock=lambda: 1.0)
    for image in read_frames(tmp_path):
        shot = capture.read()
        assert (shot.convert() == image).all()
        assert shot.thumbnail.std() > 50


@pytest.mark.parametrize("extension", [".mkv", ".ts", ".mp4"])
@pytest.mark.parametrize(("aspect", "width_px"), [("16/11", 465), ("8/9", 284), ("200/201", 320), ("9", 320)])
def test_non_square_pixels_are_resampled_unless_their_ratio_is_implausible(aspect, width_px, extension, tmp_path):
    circle = np.zeros((240, 320, 3), np.uint8)
    cv2.ellipse(circle, (160, 120), (round(160 / (width_px / 320)) // 2, 80), 0, 0, 360, (255, 255, 255), -1)
    settings = {"codec": "libx264", "sample_aspect_ratio": Fraction(aspect)}
    images = read_frames(write_video(tmp_path / f"a{extension}", [circle] * 3, "yuv420p", **settings))
    assert {image.shape for image in images} == {(240, width_px, 3)}
    *_, width, height = cv2.boundingRect((images[0][..., 1] > 128).astype(np.uint8))
    assert width == pytest.approx(height, abs=3)


def make_stereo_pair(picture: np.ndarray, shift_px: int) -> tuple[np.ndarray, np.ndarray]:
    """The views of both eyes, the second one shifted, brighter, lower and with noise of its own."""
    noise = np.random.default_rng(shift_px).normal(0, 3, picture.shape)
    other = np.roll(picture, (1, shift_px), (0, 1)) * 1.1 + 5 + noise
    return picture, np.clip(other, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("join", [np.hstack, np.vstack, lambda pair: np.hstack(pair)[:, ::2]])
@pytest.mark.parametrize("shift_px", [1, 12])
def test_stereo_check_refuses_side_by_side_images(join, shift_px):
    check = StereoCheck()
    for step in range(12):
        scene = np.roll(np.clip(SCENE, 0, 255).astype(np.uint8), 15 * step, 1)
        with pytest.raises(ImageError, match=r"halves .*videocrop"):
            check.refuse_stereo(join(make_stereo_pair(scene, shift_px)))
    for _ in range(10):
        with contextlib.suppress(ImageError):
            check.refuse_stereo(SCENE.astype(np.uint8))
    check.refuse_stereo(SCENE.astype(np.uint8))


def test_stereo_check_accepts_repetitive_ground():
    rows, columns = np.indices((240, 320))
    noise = np.random.default_rng(1).normal(0, 5, rows.shape)
    crops = 120 + 40 * np.sin((columns + 0.3 * rows) / 4)
    road = np.where(abs(columns - 160) < 12, 200, 90)
    houses = np.where((columns % 64 < 35) & (rows % 60 < 30), 60, 140)
    for ground in (crops, road, houses, np.full(rows.shape, 90)):
        picture = np.clip(ground + noise, 0, 255).astype(np.uint8)
        for turned in (picture, picture.T.copy()):
            check = StereoCheck()
            for _ in range(15):
                check.refuse_stereo(turned)


def test_folder_of_stereo_pictures_gives_no_frame(tmp_path):
    for step in range(3):
        scene = np.roll(np.clip(SCENE, 0, 255).astype(np.uint8), 15 * step, 1)
        cv2.imwrite(str(tmp_path / f"{step}.png"), np.hstack(make_stereo_pair(scene, 4)))
    problems = []
    assert not any(read_to_end(open_source(str(tmp_path), live=False), problems.append))
    assert [isinstance(problem, ImageError) and " left " in str(problem) for problem in problems] == [True] * 3
