"""The world of a soak: a lap over generated ground, the camera that films it, and the autopilot that flies it.

`python soak_world.py URL LAP.csv START_S` is that autopilot: a process that has lost GPS, and flies the lap over and
over; START_S is the monotonic time at which the first lap begins.
"""

import math
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import base  # noqa: F401
import imageio_ffmpeg
import numpy as np
from rtsp_camera import RtspCamera, free_port

from edgevpr.lab.simulate.autopilot import serve
from edgevpr.lab.simulate.brush import Scene
from edgevpr.lab.simulate.camera import CameraPose, lit, photograph
from edgevpr.lab.simulate.controller import FlightController
from edgevpr.lab.simulate.generated import (
    SCENE_DEPTH_M,
    SCENE_WIDTH_M,
    GeneratedFlight,
    later_flight,
    mapping_flight,
    write_flight,
)
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.lab.simulate.motion import AlongTrack, FlownTrack, TrueState, read_track, truth_at

SEED = 1
PICTURES_HZ = 8
FOV_DEG = 66  # of the camera of the generated flights
_CENTRE_M, _HEIGHT_M, _SPEED_M_S = (205.0, 210.0), 80.0, 8.0
_PATIENCE_S = 30.0


@dataclass(frozen=True, slots=True)
class World:
    """Files of a soak: `places` has the mapping flight, `lap` where the aircraft is at each moment of a lap of `lap_s`,
    and `film` the pictures of one."""

    places: Path
    lap: Path
    lap_s: int
    film: Path


def make_world(folder: Path, radius_m: float) -> World:
    """Write a mapping flight, and a lap around its middle, a circle of `radius_m`, as track and as film."""
    scene = make_scene(SEED, SCENE_WIDTH_M, SCENE_DEPTH_M)
    places, lap, film = folder / "places", folder / "lap", folder / "lap.mp4"
    for _ in write_flight(places, scene, mapping_flight(SEED)):
        pass
    lap_s = round(2 * math.pi * radius_m / _SPEED_M_S)  # the times of a positions.csv are whole seconds
    count = lap_s * PICTURES_HZ
    flight = replace(later_flight(SEED), poses=tuple(_poses(radius_m, count)), interval_s=1.0)
    for _ in write_flight(lap, scene, replace(flight, poses=(*flight.poses[::PICTURES_HZ], flight.poses[0]))):
        pass
    _shoot(film, scene, flight)
    return World(places=places, lap=lap / "positions.csv", lap_s=lap_s, film=film)


def _poses(radius_m: float, count: int) -> Iterator[CameraPose]:
    for turn in 2 * np.pi * np.arange(count) / count:
        east_m, north_m = (_CENTRE_M + radius_m * np.array([np.sin(turn), np.cos(turn)])).tolist()
        heading_deg = (math.degrees(turn) + 90.0) % 360
        yield CameraPose(east_m=east_m, north_m=north_m, height_m=_HEIGHT_M, heading_deg=heading_deg)


def _shoot(film: Path, scene: Scene, flight: GeneratedFlight) -> None:
    ground, rng, camera = lit(scene, flight.light, flight.seed), np.random.default_rng(SEED), flight.camera
    picture = ["-f", "rawvideo", "-pix_fmt", "bgr24", "-s", f"{camera.width}x{camera.height}", "-r", f"{PICTURES_HZ}"]
    codec = ["-c:v", "libx264", "-preset", "ultrafast", "-tune", "zerolatency", "-pix_fmt", "yuv420p", "-g", "16"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *picture, "-i", "-", *codec, str(film)]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as encoder:
        for pose in flight.poses:
            taken = photograph(ground, scene.metres_per_pixel, pose, camera, flight.light, rng)
            encoder.stdin.write(taken.tobytes())


class FilmCamera:
    """An RTSP camera (H.264) that shows the film over and over from `start_s` on, and can be pulled out, or fall
    silent. Close it."""

    def __init__(self, world: World, folder: Path) -> None:
        sdp, self._rtp_port, self._port = folder / "camera.sdp", free_port(), free_port()
        target = ["-f", "rtp", "-sdp_file", str(sdp), f"rtp://127.0.0.1:{self._rtp_port}?pkt_size=1200"]
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "quiet", "-re", "-stream_loop", "-1", "-i", str(world.film)]
        self._film = subprocess.Popen([*command, "-c", "copy", *target], stdin=subprocess.DEVNULL)
        give_up_s = time.monotonic() + _PATIENCE_S
        while not (sdp.exists() and f"m=video {self._rtp_port} " in sdp.read_text() and "fmtp" in sdp.read_text()):
            if time.monotonic() > give_up_s:
                raise RuntimeError(f"ffmpeg shows no film {world.film}")
            time.sleep(0.01)
        self.start_s = time.monotonic()
        self._sdp = sdp.read_text()
        self._server: RtspCamera | None = None
        self.plug_in()
        self.uri = self._server.uri

    def plug_in(self) -> None:
        """Answer viewers."""
        self._server = RtspCamera(self._sdp, self._rtp_port, self._port)

    def pull_out(self) -> None:
        """Refuse every viewer. The film goes on unseen."""
        if self._server:
            self._server.switch_off()
        self._server = None

    def fall_silent(self, is_silent: bool) -> None:
        """Stay connected and send nothing, or send again."""
        if self._server:
            self._server.is_silent = is_silent

    def close(self) -> None:
        self.pull_out()
        self._film.kill()
        self._film.wait()


class Autopilot:
    """The autopilot as a process at `url`, which can be killed, started anew, and stopped for a while. Close it."""

    def __init__(self, url: str, world: World, start_s: float) -> None:
        self._argv = [sys.executable, __file__, url, str(world.lap), str(world.lap_s), str(start_s)]
        self.start()

    def start(self) -> None:
        self._process = subprocess.Popen(self._argv, stdin=subprocess.DEVNULL)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def freeze(self, is_frozen: bool) -> None:
        """Let the process stand still, and its messages wait, or go on."""
        self._process.send_signal(signal.SIGSTOP if is_frozen else signal.SIGCONT)

    close = kill


class _Laps(AlongTrack):
    """Flies a track over and over by the clock, so that a new process goes on where an old one was killed."""

    def __init__(self, track: FlownTrack, lap_s: float, start_s: float) -> None:
        super().__init__(track)
        self._lap, self._lap_s, self._first_s = track, lap_s, start_s

    def step(self, now_s: float, dt_s: float) -> TrueState:
        return truth_at(self._lap, (time.monotonic() - self._first_s) % self._lap_s)


def _fly(url: str, lap: str, lap_s: str, start_s: str) -> None:
    motion = _Laps(read_track(lap), float(lap_s), float(start_s))
    serve(FlightController("arduplane", motion, gps=False), url)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        _fly(*sys.argv[1:])
