"""Fly for an hour with a faulty camera: `python benchmarks/camera_faults.py [SECONDS]`.

A simulated plane without GPS flies laps over generated ground. Its camera sends MPEG-TS with sound over TCP. It works
well for 6 to 20 s, then has a fault for 6 to 20 s, and so on, by a fixed seed; real cameras have had all these faults.
Each accepted match and each position sent to the autopilot is compared with the plane's position at that time.
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
from dataclasses import asdict, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

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
GPS_DURATION_S = 20.0  # from take-off: the flight goes on without GPS
MAX_ERROR_SIGMAS = 3.0
CAMERA = Camera(width=480, height=360, focal_px=370.0)
NO_FAULT = "well"
STAMP_SPEEDS = {"slow stamps": 0.7, "fast stamps": 1.3}
USUAL_STREAM = ("libx264", "yuv420p")
STREAMS = {"ten bits": ("libx264", "yuv420p10le"), "another codec": ("libx265", "yuv420p")}  # of the next connection
FAULTS = (
    *("frozen, with noise", "frozen, with a clock", "loop of two seconds", "three seconds late", "mirrored"),
    *("side by side", "sound only", "silent", "gone", "garbage", *STAMP_SPEEDS, *STREAMS),
)


class FaultyCamera(threading.Thread):
    """A camera that streams the images of `take` from a local TCP port, with the current `fault`."""

    def __init__(self, take: Callable[[], Image]) -> None:
        super().__init__(daemon=True)
        self._take = take
        self.fault = NO_FAULT
        self.connections = 0
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

    def _send(self, sink: Any) -> None:
        """Stream to one connection, until the camera is gone or the fault needs another kind of stream."""
        codec, pixels = stream = STREAMS.get(self.fault, USUAL_STREAM)
        options = {"max_interleave_delta": "1", "flush_packets": "1"}
        with av.open(sink, "w", format="mpegts", container_options=options) as container:
            sound = container.add_stream("mp2", rate=48000)
            video = container.add_stream(codec, rate=25)
            video.width, video.height, video.pix_fmt = CAMERA.width, CAMERA.height, pixels
            video.gop_size, video.max_b_frames, video.bit_rate = 5, 0, 3_000_000
            video.codec_context.time_base = video.time_base = Fraction(1, 90_000)
            video.options = {"preset": "ultrafast", "tune": "zerolatency", "x265-params": "log-level=error"}
            stamp_s, sound_s, last_s = 0.0, 0.0, time.monotonic()
            while self.fault != "gone" and STREAMS.get(self.fault, USUAL_STREAM) == stream:
                time.sleep(1 / RATE_HZ)
                now_s = time.monotonic()
                stamp_s += STAMP_SPEEDS.get(self.fault, 1.0) * (now_s - last_s)
                last_s = now_s
                image = self._apply_fault(self._take())
                if self.fault == "garbage":
                    sink.write(self._noise.bytes(20_000))
                if self.fault not in ("sound only", "silent", "garbage"):
                    frame = av.VideoFrame.from_ndarray(image, "bgr24").reformat(format=pixels)
                    frame.pts, frame.time_base = round(stamp_s * 90_000), Fraction(1, 90_000)
                    container.mux(video.encode(frame))
                while sound_s < stamp_s and self.fault != "silent":
                    silence = av.AudioFrame.from_ndarray(np.zeros((1, 2304), np.int16), "s16", "stereo")
                    silence.sample_rate, silence.pts = 48000, round(sound_s * 48000)
                    container.mux(sound.encode(silence))
                    sound_s += 1152 / 48000

    def _apply_fault(self, image: Image) -> Image:
        """Return the image to send in place of the image taken."""
        is_still = self.fault.startswith(("frozen", "loop"))
        if not is_still or len(self._last) < 3 * RATE_HZ:
            self._last.append(image)
        match self.fault:
            case "frozen, with noise":
                noise = self._noise.normal(0, 3, image.shape)
                return np.clip(self._last[-1] + noise, 0, 255).astype(np.uint8)
            case "frozen, with a clock":
                frozen = self._last[-1].copy()
                cv2.putText(frozen, f"{time.time():.2f}", (10, 40), 0, 1.0, (255, 255, 255), 2)
                return frozen
            case "loop of two seconds":
                self._last.rotate(-1)
                return self._last[0]
            case "three seconds late":
                return self._last[0]
            case "mirrored":
                return cv2.flip(image, 1)
            case "side by side":
                half = cv2.resize(image, (CAMERA.width // 2, CAMERA.height))
                return np.hstack([half, np.roll(half, -6, axis=1)])
        return image


class Lap:
    """A plane that flies laps. `truth`: its positions, (t_s, east_m, north_m); `sent`: the positions sent to its
    autopilot, (t_s, lat_deg, lon_deg, standard deviation in metres). Times are those of this machine's clock."""

    def __init__(self, seconds: float) -> None:
        turn_rate_rad_s = SPEED_M_S / RADIUS_M
        roll_deg = math.degrees(math.atan(SPEED_M_S**2 / RADIUS_M / 9.80665))
        track = []
        for t_s in np.arange(0.0, seconds, 0.5).tolist():
            angle = t_s * turn_rate_rad_s
            east_m, north_m = CENTRE_M[0] + RADIUS_M * math.sin(angle), CENTRE_M[1] + RADIUS_M * math.cos(angle)
            heading_deg = (90 + math.degrees(angle)) % 360
            pose = CameraPose(east_m=east_m, north_m=north_m, height_m=HEIGHT_M, heading_deg=heading_deg)
            angles = {"heading_deg": heading_deg, "roll_deg": roll_deg, "pitch_deg": 0.0}
            track.append(TrueState(**asdict(to_position(pose)), **angles, height_m=HEIGHT_M, t_s=t_s))
        self.controller = FlightController("arduplane", AlongTrack(track), gps=True, gps_until_s=GPS_DURATION_S)
        self.truth: list[tuple[float, float, float]] = []
        self.sent: list[tuple[float, float, float, float]] = []
        self._receive, self.controller.receive = self.controller.receive, self._handle_message

    def _record_truth(self) -> TrueState:
        """Record the present position of the plane, and return its state."""
        state = self.controller.brain.truth
        self.truth.append((time.monotonic(), *to_metres(state.lat_deg, state.lon_deg)))
        return state

    def record_pose(self) -> CameraPose:
        """Record the present position of the plane, and return the pose of its camera."""
        state = self._record_truth()
        east_m, north_m = to_metres(state.lat_deg, state.lon_deg)
        angles = {"heading_deg": state.heading_deg, "roll_deg": state.roll_deg}
        return CameraPose(east_m=east_m, north_m=north_m, height_m=HEIGHT_M, **angles)

    def measure_error_m(self, t_s: float, lat_deg: float, lon_deg: float) -> float:
        """Return the distance of a position from that of the plane at `t_s`."""
        truth = np.array(sorted(self.truth))
        true_m = [np.interp(t_s, truth[:, 0], truth[:, axis]) for axis in (1, 2)]
        return math.dist(true_m, to_metres(lat_deg, lon_deg))

    def _handle_message(self, message: Any) -> list:
        self._record_truth()  # while the camera is gone, no picture records it
        if message.get_type() == "COMMAND_INT" and message.command == POSITION_FIX:
            fix = time.monotonic() - message.param2, message.x / 1e7, message.y / 1e7, message.param3
            self.sent.append(fix)
        return self._receive(message)


def fly(seconds: float, folder: Path) -> base.Row:
    """Make the map, fly for `seconds`, and return the results."""
    scene = make_scene(SEED, SCENE_WIDTH_M, SCENE_DEPTH_M)
    flight = replace(plan_mapping_flight(SEED), camera=CAMERA)
    list(write_flight(folder, scene, flight))
    fov_deg = math.degrees(2 * math.atan(CAMERA.width / 2 / CAMERA.focal_px))
    lens = ("--camera", "nadir", "--fov-deg", f"{fov_deg:.2f}")
    place_map, log = folder / "map.gpkg", folder / "flight.jsonl"
    base.run_edgevpr("map", "build", place_map, "--images", folder / "images", *lens, "--no-calibrate")
    light, rng = flight.light, np.random.default_rng(SEED)
    ground, lap = light_scene(scene, light, SEED), Lap(seconds + 60)
    camera = FaultyCamera(lambda: photograph(ground, scene.metres_per_pixel, lap.record_pose(), CAMERA, light, rng))
    camera.start()
    stop, port = threading.Event(), free_port()
    threading.Thread(target=serve, args=(lap.controller, f"udpin:127.0.0.1:{port}", stop), daemon=True).start()
    flags = ("--source", camera.uri, *lens, "--link", f"udpout:127.0.0.1:{port}", "--log", log)
    with open(folder / "errors.txt", "w") as errors:
        command = [sys.executable, "-m", "edgevpr", "run", "--map", place_map, *flags]
        run = subprocess.Popen(command, stderr=errors)
    phases, memory_mb, remaining = [], [], []
    fault_rng, end_s = random.Random(SEED), time.monotonic() + seconds
    while time.monotonic() < end_s and run.poll() is None:
        remaining = remaining or fault_rng.sample(FAULTS, len(FAULTS))
        for fault in (NO_FAULT, remaining.pop()):
            camera.fault = fault
            phases.append((time.monotonic(), fault))
            time.sleep(GPS_DURATION_S + 10 if len(phases) == 1 else fault_rng.uniform(6, 20))
        if run.poll() is None:
            memory_mb.append(psutil.Process(run.pid).memory_info().rss / 1e6)
    exit_code, stop_s = run.poll(), time.monotonic()
    run.terminate()
    with suppress(subprocess.TimeoutExpired):
        run.wait(20)
    run_end = {"ended_early": exit_code, "end_s": time.monotonic() - stop_s, "connections": camera.connections}
    run.kill()
    stop.set()
    rows = summarise_faults(lap, phases, log)
    return {**base.describe_run(), **run_end, "seconds": seconds, "memory_mb": memory_mb, "rows": rows}


def summarise_faults(lap: Lap, phases: list[tuple[float, str]], log: Path) -> list[base.Row]:
    """Return a row for each fault: how often it occurred, its queries, and the errors of matches and sent positions."""
    counts = dict.fromkeys(("queries", "accepted", "accepted_wrong", "sent", "sent_wrong"), 0)
    rows = {fault: {"fault": fault, **counts, "accepted_m": 0.0, "sent_m": 0.0} for fault in (NO_FAULT, *FAULTS)}

    def find_row(t_s: float) -> base.Row:
        return rows[next((fault for begin_s, fault in reversed(phases) if begin_s <= t_s), NO_FAULT)]

    def count_position(kind: str, t_s: float, lat_deg: float, lon_deg: float, sd_m: float) -> None:
        row, error_m = find_row(t_s), lap.measure_error_m(t_s, lat_deg, lon_deg)
        row[kind] += 1
        row[f"{kind}_wrong"] += error_m > MAX_ERROR_SIGMAS * sd_m
        row[f"{kind}_m"] = max(row[f"{kind}_m"], error_m)

    for line in map(json.loads, log.read_text().splitlines()):
        if line["kind"] == "query":
            find_row(line["t_mono_s"])["queries"] += 1
        if line["kind"] == "query" and line["accepted"]:
            location = line["located"] or line["position"]
            count_position("accepted", line["t_frame_s"], location["lat_deg"], location["lon_deg"], line["accuracy_m"])
    for sent in lap.sent:
        count_position("sent", *sent)
    for row in rows.values():
        row["times"] = sum(row["fault"] == fault for _, fault in phases)
    return list(rows.values())


def format_page(result: base.Row) -> str:
    """Return the results as Markdown."""
    columns = {
        "camera": "{fault}",
        "times": "{times}",
        "queries": "{queries}",
        "accepted": "{accepted}",
        f"beyond {MAX_ERROR_SIGMAS:.0f} sigma": "{accepted_wrong}",
        "largest error, m": "{accepted_m:.1f}",
        "sent": "{sent}",
        f"sent beyond {MAX_ERROR_SIGMAS:.0f} sigma": "{sent_wrong}",
        "largest error sent, m": "{sent_m:.1f}",
    }
    memory_mb, connections = result["memory_mb"], result["connections"]
    early = "no" if result["ended_early"] is None else f"with exit code {result['ended_early']}"
    return f"""# A flight with a faulty camera

{base.strip_title(__doc__)}

{base.format_table(result["rows"], columns)}

{result["seconds"] / 60:.0f} minutes, {connections} connections to the camera. Ended early: {early}. Memory:
{memory_mb[0]:.0f} MB after the first fault, at most {max(memory_mb):.0f} MB, {memory_mb[-1]:.0f} MB at the end. The
process ended {result["end_s"]:.1f} s after SIGTERM.

{base.format_origin(result, "python benchmarks/camera_faults.py")}
"""


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 3600.0
    with tempfile.TemporaryDirectory() as folder:
        result = fly(seconds, Path(folder))
    base.write("camera-faults", result, format_page(result))


if __name__ == "__main__":
    base.run(main)
