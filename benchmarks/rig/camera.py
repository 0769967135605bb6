"""A simulated camera under the aircraft: renders the ground from the true pose and serves the pictures over HTTP.

The stream on loopback is Motion JPEG in NUT, an FFmpeg container with a time stamp for each picture, or a multipart
HTTP response without time stamps, as of cheap cameras. Each picture is rendered shortly in advance for its time of
exposure and sent at that time, so that rendering adds no delay.
"""

import contextlib
import math
import threading
import time
from dataclasses import dataclass, replace
from fractions import Fraction
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import av
import cv2
import ground
import numpy as np
from scenarios import Scenario
from truth import Truth

from edgevpr.frames.level import Mount
from edgevpr.lab.simulate.camera import CameraPose

PICTURES_HZ = 5.0
_RENDER_LEAD_S = 0.08  # more than rendering takes, 20 to 60 ms
_STAMP_UNIT_S = Fraction(1, 10_000)  # unit of the time stamps, in seconds
_MAX_TILT_DEG = 60.0  # a camera that is tilted more shows the sky
_SLOPE_LENGTH_M = 80.0  # beyond the map, the ground slopes to its other height over this distance
COLUMNS = ("t_s", "east_m", "north_m", "height_m", "heading_deg", "roll_deg", "pitch_deg")


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture, its number, and its time of exposure on the monotonic clock."""

    number: int
    t_mono_s: float
    jpeg: bytes


class Camera:
    """Serves pictures at `uri` within the `with` block, and writes the true pose of the airframe at each picture to the
    file `log`. `seed` is the seed of the noise; the `scenario` has the mount of the camera, what it sees, and whether
    pictures have time stamps. While the camera `is_frozen`, it repeats its last picture."""

    def __init__(self, truth: Truth, lit_ground: np.ndarray, log: Path, seed: int, scenario: Scenario) -> None:
        self._truth, self._ground, self._scenario, self.is_stamped = truth, lit_ground, scenario, scenario.is_stamped
        self._log, self._rng = log, np.random.default_rng(seed)
        self._picture: Picture | None = None
        self._is_on, self._changed = True, threading.Condition()
        self.is_frozen = False
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _Viewer)
        self._server.daemon_threads = True
        self._server.camera = self  # type: ignore[attr-defined]
        self.uri = f"http://127.0.0.1:{self._server.server_port}/"
        self._threads = [threading.Thread(target=work) for work in (self._server.serve_forever, self._take_pictures)]

    def __enter__(self) -> "Camera":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_on = False
        self._server.shutdown()
        for thread in self._threads:
            thread.join()
        self._server.server_close()

    def wait_picture(self, after: int) -> Picture | None:
        """Wait for a picture with a number greater than `after` and return it; None if the camera is off."""
        with self._changed:
            self._changed.wait_for(lambda: (self._picture and self._picture.number > after) or not self._is_on)
            return self._picture if self._is_on else None

    def _take_pictures(self) -> None:
        due_s = time.monotonic() + 1.0
        number = 0
        with open(self._log, "w", encoding="utf-8", buffering=1) as log:
            log.write(",".join(COLUMNS) + "\n")
            while self._is_on:
                due_s = max(due_s + 1 / PICTURES_HZ, time.monotonic())  # skips pictures that are overdue
                time.sleep(max(0.0, due_s - _RENDER_LEAD_S - time.monotonic()))
                pose = self._truth.compute_pose(due_s)
                if pose is None:
                    continue
                if not (self.is_frozen and self._picture):
                    jpeg = self._render(pose)
                time.sleep(max(0.0, due_s - time.monotonic()))
                number += 1
                with self._changed:
                    self._picture = Picture(number, due_s, jpeg)
                    self._changed.notify_all()
                values = (pose.east_m, pose.north_m, pose.height_m, pose.heading_deg, pose.roll_deg, pose.pitch_deg)
                log.write(",".join((f"{due_s:.4f}", *(f"{value:.3f}" for value in values))) + "\n")
        with self._changed:
            self._changed.notify_all()

    def _render(self, pose: CameraPose) -> bytes:
        if self._scenario.is_blind:
            return _make_noise_jpeg(self._rng)
        pose = replace(pose, height_m=max(pose.height_m * self._compute_ground_scale(pose.north_m), 1.0))
        if self._scenario.is_level:
            pose = replace(pose, roll_deg=0.0, pitch_deg=0.0)
        elif max(abs(pose.roll_deg), abs(pose.pitch_deg)) > _MAX_TILT_DEG:
            pose = replace(pose, height_m=1.0, roll_deg=0.0, pitch_deg=0.0)  # too low to show anything
        return ground.take_picture(self._ground, apply_mount(pose, self._scenario.mount), "later", self._rng)

    def _compute_ground_scale(self, north_m: float) -> float:
        """Return the height above ground at `north_m`, divided by the height above the mapped ground."""
        if self._scenario.mapped_m is None:
            return 1.0
        slope_share = min(max((north_m - self._scenario.mapped_m) / _SLOPE_LENGTH_M, 0.0), 1.0)
        return 1.0 + slope_share * (self._scenario.beyond_scale - 1.0)


def _make_noise_jpeg(rng: np.random.Generator) -> bytes:
    """Return a picture of smooth noise, which matches no map, as a JPEG."""
    camera = ground.CAMERAS["later"]
    grains = rng.integers(0, 255, (camera.height // 8, camera.width // 8, 3), np.uint8)
    noise = cv2.resize(grains, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
    return cv2.imencode(".jpg", noise)[1].tobytes()


def apply_mount(pose: CameraPose, mount: Mount) -> CameraPose:
    """Return the pose of a camera with this mount, from the pose of the airframe."""
    heading = cv2.Rodrigues(np.radians((0.0, 0.0, pose.heading_deg)))[0]
    attitude = Mount(pose.pitch_deg, -pose.roll_deg).body_from_straight()
    (nose, *_), (right, *_), (down, *below) = heading @ attitude @ mount.body_from_straight()
    angles = math.atan2(right, nose), math.atan2(*below), -math.asin(down)
    return replace(pose, **dict(zip(("heading_deg", "roll_deg", "pitch_deg"), map(math.degrees, angles), strict=True)))


class _Viewer(BaseHTTPRequestHandler):
    server: Any  # an HTTP server with an attribute `camera`

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        is_stamped = self.server.camera.is_stamped
        self.send_response(200)
        self.send_header("Content-Type", "video/x-nut" if is_stamped else "multipart/x-mixed-replace; boundary=picture")
        self.end_headers()
        with contextlib.suppress(OSError, av.FFmpegError):  # the viewer has disconnected
            if is_stamped:
                self._send_stamped()
            else:
                self._send_parts()

    def _send_parts(self) -> None:
        picture = self.server.camera.wait_picture(0)
        while picture:
            header = f"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture.jpeg)}\r\n\r\n"
            self.wfile.write(header.encode() + picture.jpeg + b"\r\n")
            picture = self.server.camera.wait_picture(picture.number)

    def _send_stamped(self) -> None:
        options = {"flush_packets": "1", "write_index": "0"}
        with av.open(_Sink(self.wfile), "w", format="nut", options=options, buffer_size=4096) as container:
            stream = container.add_stream("mjpeg", rate=int(PICTURES_HZ))
            camera = ground.CAMERAS["later"]
            stream.width, stream.height = camera.width, camera.height
            stream.pix_fmt, stream.time_base = "yuvj420p", _STAMP_UNIT_S
            picture, began_s = self.server.camera.wait_picture(0), None
            while picture:
                began_s = began_s or picture.t_mono_s
                packet = av.Packet(picture.jpeg)
                packet.stream, packet.time_base, packet.is_keyframe = stream, _STAMP_UNIT_S, True
                packet.pts = packet.dts = round((picture.t_mono_s - began_s) / _STAMP_UNIT_S)
                container.mux(packet)
                self.wfile.flush()
                picture = self.server.camera.wait_picture(picture.number)


class _Sink:
    """A write-only file for FFmpeg, which must not seek."""

    def __init__(self, file) -> None:
        self._file = file

    def write(self, data: bytes) -> int:
        self._file.write(data)
        return len(data)
