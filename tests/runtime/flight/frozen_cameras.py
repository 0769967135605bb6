"""A camera over generated ground, beside an aircraft whose motion is given: its pictures are judged one by one. What
harms them: a sensor that hangs behind an encoder, and a clock."""

import io
from unittest.mock import Mock

import av
import cv2
import numpy as np
from fakes import make_vehicle

from edgevpr.core.types import Frame
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, light_scene, photograph
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.runtime.flight.frozenwatch import FrozenWatch, Optics

HEIGHT_M = 80.0
METRES_PER_PIXEL = 0.4
LIGHT = Light(sun_azimuth_deg=48, sun_elevation_deg=52)
CAMERA = Camera(noise_sigma=4.0)
DOWN = Optics(focal=0.77, looks_down=True, is_level=False)


def make_ground() -> np.ndarray:
    return light_scene(make_scene(3, 400, 240, metres_per_pixel=METRES_PER_PIXEL), LIGHT, 3)


class CameraFlight:
    """A flight with a picture every `every_s`, whose reports are wrong by `attitude_sd` degrees. `refused`: of each."""

    def __init__(self, ground, optics=DOWN, every_s=1.0, attitude_sd=0.5):
        self.notifier, self.autopilot, self.rng = Mock(), Mock(), np.random.default_rng(1)
        self.watch = FrozenWatch(self.notifier, optics, self.autopilot)
        self.refused, self._ground, self._every_s, self._sd, self.t_s = [], ground, every_s, attitude_sd, 100.0

    @property
    def notes(self):
        """What is reported."""
        return [str(call.args[2]) for call in self.notifier.report.call_args_list]

    def photograph(self, east_m=200.0, north_m=120.0, height_m=HEIGHT_M, heading_deg=90.0, roll_deg=0.0, pitch_deg=0.0):
        place = {"east_m": east_m, "north_m": north_m, "height_m": height_m}
        pose = CameraPose(**place, heading_deg=heading_deg, roll_deg=roll_deg, pitch_deg=pitch_deg)
        return compress(photograph(self._ground, METRES_PER_PIXEL, pose, CAMERA, LIGHT, self.rng), self.rng)

    def show(self, picture, heading_deg=90.0, roll_deg=0.0, pitch_deg=0.0, velocity_m_s=(0.0, 0.0), height_m=HEIGHT_M):
        """Judge a picture; return why it is refused."""
        self.t_s += self._every_s
        off_deg = self.rng.normal(0, self._sd, 3)
        reported = {"heading_deg": heading_deg + off_deg[0], "height_m": height_m}
        reported |= {"roll_deg": roll_deg + off_deg[1], "pitch_deg": pitch_deg + off_deg[2]}
        reported["velocity_m_s"] = tuple(np.add(velocity_m_s, self.rng.normal(0, 0.4, 2)))
        vehicle = make_vehicle(47.0, 8.0, self.t_s, **reported)
        self.refused.append(self.watch.judge(Frame(image=picture, name="", t_mono_s=self.t_s), vehicle))
        return self.refused[-1]

    def fly_on(self, count, speed_m_s, start_m=60.0, **how):
        """Fly to the east; return the pictures."""
        pictures = []
        for number in range(count):
            pictures.append(self.photograph(east_m=start_m + number * speed_m_s * self._every_s, **how))
            self.show(pictures[-1], velocity_m_s=(speed_m_s, 0.0))
        return pictures


def compress(picture, rng):
    """The picture as a JPEG of some quality."""
    quality = int(rng.integers(20, 90))
    return cv2.imdecode(cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, quality))[1], cv2.IMREAD_COLOR)


def encode_at_constant_bitrate(picture, count, kbit_s=200):
    """A picture sent `count` times by an encoder at constant bitrate, as it is decoded."""
    sent = io.BytesIO()
    with av.open(sent, "w", format="mpegts") as box:
        options = {"preset": "ultrafast", "tune": "zerolatency", "maxrate": f"{kbit_s}k", "bufsize": f"{kbit_s}k"}
        stream = box.add_stream("libx264", rate=25, options=options)
        stream.height, stream.width = picture.shape[:2]
        stream.pix_fmt, stream.bit_rate, stream.codec_context.gop_size = "yuv420p", 1000 * kbit_s, 10
        for _ in range(count):
            box.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "bgr24")))
        box.mux(stream.encode())
    sent.seek(0)
    with av.open(sent) as box:
        return [frame.to_ndarray(format="bgr24") for frame in box.decode(video=0)]


def draw_clock(picture, number):
    """The picture with a clock that runs, and the numbers of a display."""
    picture = picture.copy()
    text = f"12:00:{number % 60:02d}.{number * 37 % 100:02d}"
    cv2.putText(picture, text, (20, 60), cv2.FONT_HERSHEY_SIMPLEX, 2, (255, 255, 255), 3)
    cv2.putText(picture, f"ALT {80 + number % 7} SPD {number % 13}", (20, 460), 0, 1, (0, 255, 0), 2)
    return picture
