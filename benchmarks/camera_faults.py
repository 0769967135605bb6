"""A flight of an hour whose camera misbehaves: `python benchmarks/camera_faults.py [SECONDS]`.

A simulated plane without GPS flies laps over generated ground. Its camera sends MPEG-TS with sound by TCP and, for 6
to 20 s at a time and by a fixed seed, does one thing that cameras were seen to do, then is well for as long. Each
accepted match and each position that the autopilot was sent is compared with where the plane was then.
"""

import json
import math
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import base
import cv2
import numpy as np
import psutil
from loopback import free_port
from simulated.autopilot import serve
from simulated.controller import FlightController
from simulated.motion import AlongTrack, TrueState

from edgevpr.core.arrays import Image
from edgevpr.lab.simulate.camera import Camera, CameraPose, light_scene, photograph
from edgevpr.lab.simulate.generated import (
    SCENE_DEPTH_M,
    SCENE_WIDTH_M,
    plan_mapping_flight,
    to_metres,
    to_position,
    write_flight,
)
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.mavlink.messages import POSITION_FIX

SEED = 4
RATE_HZ = 5
CENTRE_M = (205.0, 210.0)
RADIUS_M = 90.0
HEIGHT_M = 80.0
SPEED_M_S = 12.0
GPS_S = 20.0  # of the flight with GPS
SIGMAS = 3.0
CAMERA = Camera(width=480, height=360, focal_px=370.0)
WELL = "well"
SPEEDS = {"slow stamps": 0.7, "fast stamps": 1.3}
USUAL = ("libx264", "yuv420p")
STREAMS = {"ten bits": ("libx264", "yuv420p10le"), "another codec": ("libx265", "yuv420p")}  # of a new connection
FAULTS = (
    *("frozen, with noise", "frozen, with a clock", "loop of two seconds", "three seconds late", "mirrored"),
    *("side by side", "sound only", "silent", "gone", "garbage", *SPEEDS, *STREAMS),
)


class FaultyCamera(threading.Thread):
    """Sends what `take` returns through a port of this machine, as `fault` says."""

    def __init__(self, take: Callable[[], Image]) -> None:
        super().__init__(daemon=True)
        self._take, self.fault, self.connections = take, WELL, 0
        self._server = socket.create_server(("127.0.0.1", 0))
        self.uri = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        self._last: deque[Image] = deque(maxlen=3 * RATE_HZ)
        self._noise = np.random.default_rng(SEED)

    def run(self) -> None:
        while True:
            connection, _ = self._server.accept()
            self.connections += 1
            with connection, suppress(OSError, av.FFmpegError):
                if self.fault != "gone":
                    self._send(connection.makefile("wb", buffering=0))

    def _send(self, sink: object) -> None:
        codec, pixels = stream = STREAMS.get(self.fault, USUAL)
        options = {"max_interleave_delta": "1", "flush_packets": "1"}
        with av.open(sink, "w", format="mpegts", container_options=options) as container:
            sound = container.add_stream("mp2", rate=48000)
            video = container.add_stream(codec, rate=25)
            video.width, video.height, video.pix_fmt = CAMERA.width, CAMERA.height, pixels
            video.gop_size, video.max_b_frames, video.bit_rate = 5, 0, 3_000_000
            video.codec_context.time_base = video.time_base = Fraction(1, 90_000)
            video.options = {"preset": "ultrafast", "tune": "zerolatency", "x265-params": "log-level=error"}
            stamp_s, sound_s, at_s = 0.0, 0.0, time.monotonic()
            while self.fault != "gone" and STREAMS.get(self.fault, USUAL) == stream:
                time.sleep(1 / RATE_HZ)
                now_s = time.monotonic()
                stamp_s += SPEEDS.get(self.fault, 1.0) * (now_s - at_s)
                at_s = now_s
                shown = self._shown(self._take())
                if self.fault == "garbage":
                    sink.write(self._noise.bytes(20_000))
                if self.fault not in ("sound only", "silent", "garbage"):
                    frame = av.VideoFrame.from_ndarray(shown, "bgr24").reformat(format=pixels)
                    frame.pts, frame.time_base = round(stamp_s * 90_000), Fraction(1, 90_000)
                    container.mux(video.encode(frame))
                while sound_s < stamp_s and self.fault != "silent":
                    silence = av.AudioFrame.from_ndarray(np.zeros((1, 2304), np.int16), "s16", "stereo")
                    silence.sample_rate, silence.pts = 48000, round(sound_s * 48000)
                    container.mux(sound.encode(silence))
                    sound_s += 1152 / 48000

    def _shown(self, taken: Image) -> Image:
        """Return what is sent in place of the picture that was taken."""
        is_still = self.fault.startswith(("frozen", "loop"))
        if not is_still or len(self._last) < 3 * RATE_HZ:
            self._last.append(taken)
        match self.fault:
            case "frozen, with noise":
                noise = self._noise.normal(0, 3, taken.shape)
                return np.clip(self._last[-1] + noise, 0, 255).astype(np.uint8)
            case "frozen, with a clock":
                clock = self._last[-1].copy()
                cv2.putText(clock, f"{time.time():.2f}", (10, 40), 0, 1.0, (255, 255, 255), 2)
                return clock
            case "loop of two seconds":
                self._last.rotate(-1)
                return self._last[0]
            case "three seconds late":
                return self._last[0]
            case "mirrored":
                return cv2.flip(taken, 1)
            case "side by side":
                eye = cv2.resize(taken, (CAMERA.width // 2, CAMERA.height))
                return np.hstack([eye, np.roll(eye, -6, axis=1)])
        return taken


class Lap:
    """The plane on its laps: `truth` has where it was, and `sent` what its autopilot was sent, by our clock."""

    def __init__(self, seconds: float) -> None:
        turn = SPEED_M_S / RADIUS_M
        roll_deg = math.degrees(math.atan(SPEED_M_S**2 / RADIUS_M / 9.80665))
        track = []
        for t_s in np.arange(0.0, seconds, 0.5).tolist():
            at = self._pose(t_s * turn)
            place = to_position(at)
            where = {"lat_deg": place.lat_deg, "lon_deg": place.lon_deg, "alt_m": place.alt_m, "height_m": HEIGHT_M}
            angles = {"heading_deg": at.heading_deg, "roll_deg": roll_deg, "pitch_deg": 0.0}
            track.append(TrueState(**where, **angles, t_s=t_s))
        self.controller = FlightController("arduplane", AlongTrack(track), gps=True, gps_until_s=GPS_S)
        self.truth: list[tuple[float, float, float]] = []
        self.sent: list[tuple[float, float, float, float]] = []
        self._receive, self.controller.receive = self.controller.receive, self._note

    def _keep(self) -> TrueState:
        """Keep where the plane is now, and return it."""
        state = self.controller.brain.truth
        self.truth.append((time.monotonic(), *to_metres(state.lat_deg, state.lon_deg)))
        return state

    def pose(self) -> CameraPose:
        """Return where the camera is now."""
        state = self._keep()
        east_m, north_m = to_metres(state.lat_deg, state.lon_deg)
        angles = {"heading_deg": state.heading_deg, "roll_deg": state.roll_deg}
        return CameraPose(east_m=east_m, north_m=north_m, height_m=HEIGHT_M, **angles)

    def off_m(self, t_s: float, lat_deg: float, lon_deg: float) -> float:
        """Return how far a position is from where the plane was at `t_s`."""
        known = np.array(sorted(self.truth))
        true_m = [np.interp(t_s, known[:, 0], known[:, axis]) for axis in (1, 2)]
        return math.dist(true_m, to_metres(lat_deg, lon_deg))

    def _note(self, message: object) -> list:
        self._keep()  # a camera that is gone asks for no pose
        if message.get_type() == "COMMAND_INT" and message.command == POSITION_FIX:
            at = time.monotonic() - message.param2, message.x / 1e7, message.y / 1e7, message.param3
            self.sent.append(at)
        return self._receive(message)

    @staticmethod
    def _pose(angle: float) -> CameraPose:
        east_m, north_m = CENTRE_M[0] + RADIUS_M * math.sin(angle), CENTRE_M[1] + RADIUS_M * math.cos(angle)
        heading_deg = (90 + math.degrees(angle)) % 360
        return CameraPose(east_m=east_m, north_m=north_m, height_m=HEIGHT_M, heading_deg=heading_deg)


def fly(seconds: float, folder: Path) -> base.Row:
    """Make the map, fly, and return what was seen."""
    scene = make_scene(SEED, SCENE_WIDTH_M, SCENE_DEPTH_M)
    flight = replace(plan_mapping_flight(SEED), camera=CAMERA)
    list(write_flight(folder, scene, flight))
    fov_deg = math.degrees(2 * math.atan(CAMERA.width / 2 / CAMERA.focal_px))
    look = ("--camera", "nadir", "--fov-deg", f"{fov_deg:.2f}")
    program, place_map, log = [sys.executable, "-m", "edgevpr"], folder / "map.gpkg", folder / "flight.jsonl"
    subprocess.run(
        [*program, "map", "build", place_map, "--images", folder / "images", *look, "--no-calibrate"], check=True
    )
    ground, lap, rng = light_scene(scene, flight.light, SEED), Lap(seconds + 60), np.random.default_rng(SEED)
    camera = FaultyCamera(lambda: photograph(ground, scene.metres_per_pixel, lap.pose(), CAMERA, flight.light, rng))
    camera.start()
    stop, port = threading.Event(), free_port()
    threading.Thread(target=serve, args=(lap.controller, f"udpin:127.0.0.1:{port}", stop), daemon=True).start()
    link = ("--link", f"udpout:127.0.0.1:{port}", "--log", log)
    with open(folder / "said.txt", "w") as said:
        run = subprocess.Popen([*program, "run", "--map", place_map, "--source", camera.uri, *look, *link], stderr=said)
    phases, memory_mb, left = [], [], []
    dice, end_s = random.Random(SEED), time.monotonic() + seconds
    while time.monotonic() < end_s and run.poll() is None:
        left = left or dice.sample(FAULTS, len(FAULTS))
        for fault in (WELL, left.pop()):
            camera.fault = fault
            phases.append((time.monotonic(), fault))
            time.sleep(GPS_S + 10 if len(phases) == 1 else dice.uniform(6, 20))
        if run.poll() is None:
            memory_mb.append(psutil.Process(run.pid).memory_info().rss / 1e6)
    code, asked_s = run.poll(), time.monotonic()
    run.terminate()
    with suppress(subprocess.TimeoutExpired):
        run.wait(20)
    ended = {"ended_early": code, "end_s": time.monotonic() - asked_s, "connections": camera.connections}
    run.kill()
    stop.set()
    rows = rows_of(lap, phases, log)
    return {**base.made_by(), **ended, "seconds": seconds, "memory_mb": memory_mb, "rows": rows}


def rows_of(lap: Lap, phases: list[tuple[float, str]], log: Path) -> list[base.Row]:
    """Return a row for each fault: how often it came, its queries, and the largest errors of matches and positions."""
    counts = dict.fromkeys(("queries", "accepted", "accepted_wrong", "sent", "sent_wrong"), 0)
    rows = {fault: {"fault": fault, **counts, "accepted_m": 0.0, "sent_m": 0.0} for fault in (WELL, *FAULTS)}

    def row_at(t_s: float) -> base.Row:
        return rows[next((fault for begin_s, fault in reversed(phases) if begin_s <= t_s), WELL)]

    def note(kind: str, t_s: float, lat_deg: float, lon_deg: float, sd_m: float) -> None:
        row, off_m = row_at(t_s), lap.off_m(t_s, lat_deg, lon_deg)
        row[kind] += 1
        row[f"{kind}_wrong"] += off_m > SIGMAS * sd_m
        row[f"{kind}_m"] = max(row[f"{kind}_m"], off_m)

    for line in map(json.loads, log.read_text().splitlines()):
        if line["kind"] == "query":
            row_at(line["t_mono_s"])["queries"] += 1
        if line["kind"] == "query" and line["accepted"]:
            at = line["located"] or line["position"]
            note("accepted", line["t_frame_s"], at["lat_deg"], at["lon_deg"], line["accuracy_m"])
    for sent in lap.sent:
        note("sent", *sent)
    for row in rows.values():
        row["times"] = sum(row["fault"] == fault for _, fault in phases)
    return list(rows.values())


def page(found: base.Row) -> str:
    columns = {
        "camera": "{fault}",
        "times": "{times}",
        "queries": "{queries}",
        "accepted": "{accepted}",
        f"beyond {SIGMAS:.0f} sigma": "{accepted_wrong}",
        "farthest off, m": "{accepted_m:.1f}",
        "sent": "{sent}",
        f"of these beyond {SIGMAS:.0f} sigma": "{sent_wrong}",
        "farthest sent, m": "{sent_m:.1f}",
    }
    memory_mb = found["memory_mb"]
    early = "no" if found["ended_early"] is None else f"with exit code {found['ended_early']}"
    return f"""# A camera that misbehaves

{base.told(__doc__)}

{base.table(found["rows"], columns)}

{found["seconds"] / 60:.0f} minutes, {found["connections"]} connections of the camera. Ended early: {early}. Memory, MB:
{memory_mb[0]:.0f} after the first fault, at most {max(memory_mb):.0f}, in the end {memory_mb[-1]:.0f}. After SIGTERM it
ended in {found["end_s"]:.1f} s.

{base.made_line(found, "python benchmarks/camera_faults.py")}
"""


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 3600.0
    with tempfile.TemporaryDirectory() as folder:
        found = fly(seconds, Path(folder))
    base.write("camera-faults", found, page(found))


if __name__ == "__main__":
    base.run(main)
