"""Flights behind damaged streams: what leaves the aircraft for pictures that are cut, corrupted, truncated or lost.

The ground passes by under the camera by a whole picture a second, along a line, so that every position of the map
belongs to one moment: a fix tells when the picture was sent that it was made from.
"""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from base import Row
from damaged_streams import Camera, Film, Stream, streams
from flight_process import start, wait_for
from rtsp_camera import free_port

from edgevpr.cli.main import main
from edgevpr.lab.simulate import camera as simulated
from edgevpr.lab.simulate.autopilot import serve
from edgevpr.lab.simulate.controller import FlightController
from edgevpr.lab.simulate.generated import GeneratedFlight, to_metres, write_flight
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.lab.simulate.motion import Motion
from edgevpr.mavlink.wire import Message, mavlink
from edgevpr.runtime.flight.flightlog import read_log

RATE_HZ = 40.0
# As often as the machine can; few candidates and a coarse technique, so that it can often.
_FLAGS = ("--rate-hz", "20", "--candidates", "4")
_TECHNIQUE = ("--technique", "cohog", "--camera", "nadir", "--param", "w1=320")
# Fourteen seconds: an autopilot that tells no position is sent fixes from 5 s after its first heartbeat on, and once it
# has answered for its parameters.
_WHOLE_AT_FIRST = 560
_HEIGHT_M, _METRES_PER_PIXEL = 80.0, 0.32
_STEP_M = 6 * _METRES_PER_PIXEL  # a picture of 240 rows passes in a second
_PICTURES_A_PLACE = 8
_PLACE_S = _PICTURES_A_PLACE / RATE_HZ
_LIMIT_S = 1.0 + _PLACE_S / 2
_LINE_NORTH_M, _BEGIN_EAST_M = 60.0, 60.0
_DEPTH_M = 320.0  # the road that crosses every scene from west to east passes north of the line
_LENS = simulated.Camera(width=320, height=240, focal_px=_HEIGHT_M / _METRES_PER_PIXEL)


def run(count: int, seed: int, only: Callable[[str], bool] = lambda stream: True) -> list[Row]:
    """Fly `count` pictures far behind every stream whose name is wanted; the last row is the sum of all damaged ones.

    A row tells of one stream: pictures `sent`, `queries` asked with those that were taken, and `fixes` that reached the
    autopilot; of a damaged stream those for pictures said to be taken since the damage began. Of the fixes, `old` say a
    place that had passed more than a second, and half a place's spacing, before the time that they claim, and `ahead`
    one that was as far ahead; `oldest_s` is the most that any was behind."""
    with TemporaryDirectory(prefix="edgevpr-flights-") as name:
        film, place_map = _land(Path(name), count, seed)
        rows = []
        for number, stream in enumerate(each for each in streams() if only(each.name)):
            log = place_map.with_name(f"{number}.jsonl")
            rows.append(_flown(stream, stream.camera(film, seed), film, place_map, log))
    damaged = [row for row in rows if not row["is_whole"]]
    sums = {name: sum(row[name] for row in damaged) for name in ("sent", "queries", "fixes", "old", "ahead")}
    oldest_s = max((row["oldest_s"] for row in damaged), default=0.0)
    return [*rows, {"stream": "all that are damaged", "is_whole": False, **sums, "oldest_s": oldest_s}]


class _Noting(FlightController):
    """A simulated flight controller that keeps the fixes which it has accepted, with their time on our clock."""

    def __init__(self) -> None:
        super().__init__("arduplane", Motion(), gps=False)
        self.fixes: list[Message] = []

    def hear(self, message: Message) -> list[Message]:
        answers = super().hear(message)
        if message.get_type() == "COMMAND_INT" and answers[0].result == mavlink.MAV_RESULT_ACCEPTED:
            message.param1 += time.monotonic() - self.brain.boot_s  # a fix carries the autopilot's time
            self.fixes.append(message)
        return answers


def behind_s(fixes: Sequence[Message], sent_s: dict[int, float]) -> np.ndarray:
    """Return by how many seconds each fix is older than it claims, float64 (N,): from the time at which the picture of
    its position was sent to the time that it gives for its own."""
    east_m = [to_metres(fix.x / 1e7, fix.y / 1e7)[0] for fix in fixes]
    numbers = (np.array(east_m) - _BEGIN_EAST_M) / _STEP_M
    return np.array([_claimed_s(fix) for fix in fixes]) - np.interp(numbers, list(sent_s), list(sent_s.values()))


def _claimed_s(fix: Message) -> float:
    return float(fix.param1 - fix.param2)


def _land(folder: Path, count: int, seed: int) -> tuple[Film, Path]:
    """Make a landscape; return what a later flight over it films, and the map of an earlier one at another hour."""
    scene = make_scene(seed, 2 * _BEGIN_EAST_M + count * _STEP_M, _DEPTH_M, _METRES_PER_PIXEL)
    rng = np.random.default_rng((seed, 1))
    earlier = GeneratedFlight(
        poses=tuple(_mapped_from(number, rng) for number in range(0, count, _PICTURES_A_PLACE)),
        light=simulated.Light(sun_azimuth_deg=48, sun_elevation_deg=52, exposure=1.12),
        camera=_LENS,
        start_utc=datetime(2026, 2, 14, 0, 30, tzinfo=timezone.utc),
        interval_s=_PLACE_S,
        seed=seed,
    )
    list(write_flight(folder, scene, earlier))
    place_map = folder / "map.gpkg"
    built = ["map", "build", place_map, "--images", folder / "images", *_TECHNIQUE]
    if main([*map(str, built)]):
        raise RuntimeError("the map of the flights could not be made")
    light = simulated.Light(sun_azimuth_deg=20, sun_elevation_deg=58, warmth=0.4, exposure=1.05)
    ground = simulated.lit(scene, light, seed + 1)

    def picture(number: int) -> np.ndarray:
        noise = np.random.default_rng((seed, 2, number))
        return simulated.photograph(ground, scene.metres_per_pixel, _pose(number), _LENS, light, noise)

    return Film(picture=picture, count=count, rate_hz=RATE_HZ, whole_at_first=_WHOLE_AT_FIRST), place_map


def _pose(number: float) -> simulated.CameraPose:
    east_m = _BEGIN_EAST_M + number * _STEP_M
    return simulated.CameraPose(east_m=east_m, north_m=_LINE_NORTH_M, height_m=_HEIGHT_M, heading_deg=90.0)


def _mapped_from(number: int, rng: np.random.Generator) -> simulated.CameraPose:
    exact, off = _pose(number), dict(zip(("north_m", "height_m", "heading_deg"), rng.normal(0, 1, 3), strict=True))
    return replace(exact, **{name: getattr(exact, name) + each for name, each in off.items()})


def _flown(stream: Stream, camera: Camera, film: Film, place_map: Path, log: Path) -> Row:
    with _autopilot() as (link, received):
        flight = start(place_map, camera.uri, log, "--link", link, *_FLAGS)
        wait_for("start", log, flight)
        camera.roll()
        camera.done.wait()
        flight.terminate()
        flight.communicate(timeout=60)
        fixes = received()
    camera.close()
    begin_s = 0.0 if stream.is_whole else camera.sent_s[film.whole_at_first]
    fixes = [fix for fix in fixes if _claimed_s(fix) > begin_s]
    older_s = behind_s(fixes, camera.sent_s)
    return {
        "stream": stream.name,
        "is_whole": stream.is_whole,
        "sent": len(camera.sent_s),
        "queries": sum(line["kind"] == "query" and line["t_frame_s"] > begin_s for line in read_log(log)),
        "fixes": len(fixes),
        "old": int((older_s > _LIMIT_S).sum()),
        "ahead": int((older_s < -_LIMIT_S).sum()),
        "oldest_s": float(older_s.max(initial=0.0)),
    }


@contextmanager
def _autopilot() -> Iterator[tuple[str, Callable[[], list[Message]]]]:
    """A simulated flight controller; gives the link to it, and a call that ends it and returns the fixes received."""
    address, stop, controller = f"127.0.0.1:{free_port()}", threading.Event(), _Noting()
    thread = threading.Thread(target=serve, args=(controller, f"udpin:{address}", stop))
    thread.start()

    def received() -> list[Message]:
        stop.set()
        thread.join()
        return controller.fixes

    try:
        yield f"udpout:{address}", received
    finally:
        stop.set()
        thread.join()
