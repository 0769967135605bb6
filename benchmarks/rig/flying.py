"""One run of a scenario: the simulator, the camera and edgevpr between them, and a record of it all in a folder."""

import json
import shutil
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import base
import ground
from camera import Camera
from recording import COMPANION, Recorder
from relay import Relay
from scenarios import (
    CIRCUIT_M,
    CLIMB_M,
    COPTER_CIRCUIT_M,
    COPTER_HOME_M,
    COPTER_SPEED_M_S,
    HEIGHT_M,
    HOME_M,
    VEHICLE_PARAMETERS,
    WIND_FROM_DEG,
    Scenario,
)
from simulator import Simulator, at_degrees, mission
from truth import Truth

from edgevpr.mavlink.wire import mavlink

_STEP_S = 0.1
_SAID_EVERY_S = 10.0
_RETURN_S = 8.0  # an autopilot that was rebooted is back after so long
_ONLY_VELOCITY = 0b0000110111000111  # of SET_POSITION_TARGET_LOCAL_NED: position, acceleration and yaw do not count
_EARTH_DEGREE_M = (at_degrees(0.0, 1.0)[0] - at_degrees(0.0, 0.0)[0]) ** -1


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A run to be made: a scenario with or without edgevpr, its seconds and rate, and extra words for `edgevpr run`."""

    name: str
    scenario: Scenario
    is_control: bool
    instance: int
    rate_hz: float
    words: tuple[str, ...]
    folder: Path
    work: Path


class Run:
    """A run between its begin and its end (`with`)."""

    def __init__(self, plan: Plan) -> None:
        self._plan, self._scenario, self._folder = plan, plan.scenario, plan.folder
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(parents=True)
        self.truth, self._open = Truth(), ExitStack()
        self.recorder = Recorder(self.truth, self._folder / "track.csv")
        self._edgevpr: subprocess.Popen | None = None
        self._camera: Camera | None = None
        self._relay: Relay | None = None
        self.marks_s: dict[str, float] = {}
        self._corner = 0

    def __enter__(self) -> "Run":
        plan, scenario = self._plan, self._scenario
        place_map = ground.place_map(plan.work)
        self._map = self._folder / "learnt.gpkg" if scenario.learns else place_map
        home_m = COPTER_HOME_M if scenario.vehicle == "copter" else HOME_M
        more = {} if plan.is_control else scenario.with_edgevpr
        with ExitStack() as stack:
            stack.callback(self.recorder.close)
            self._simulator = stack.enter_context(
                Simulator(
                    scenario.vehicle,
                    self._folder / "simulator",
                    instance=plan.instance,
                    home_m=home_m,
                    parameters={**VEHICLE_PARAMETERS[scenario.vehicle], **scenario.parameters, **more},
                    listeners=[self.truth.listen, self.recorder.listen],
                )
            )
            if not plan.is_control:
                self._camera = stack.enter_context(
                    Camera(
                        self.truth,
                        ground.lit_ground(plan.work, "later"),
                        is_level=scenario.is_level,
                        is_stamped=scenario.is_stamped,
                        port=8090 + plan.instance,
                        log=self._folder / "pictures.csv",
                    )
                )
                self._relay = stack.enter_context(
                    Relay(
                        self.truth,
                        self._folder / "sent.csv",
                        autopilot_port=self._simulator.companion_port,
                        port=8290 + plan.instance,
                        origin_m=home_m,
                    )
                )
            stack.callback(self.end_edgevpr)
            self._open = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def fly(self) -> None:
        """Fly the scenario."""
        scenario = self._scenario
        if scenario.starts_early:
            self.start_edgevpr()
        self._take_off()
        self.recorder.is_on = True
        self.start_edgevpr()
        self._watch(scenario.gps_s)
        if scenario.reboots:
            self._lose()
            self._watch(20.0)
            self._reboot()
            self._watch(scenario.gps_s)
        self._lose()
        self._watch(scenario.off_s)

    def start_edgevpr(self) -> None:
        """Start edgevpr, unless it runs or is not to be in this flight."""
        if self._plan.is_control or self._edgevpr:
            return
        config = self._folder / "config.yaml"
        config.write_text(json.dumps(self._config(), indent=1))  # JSON is YAML
        command = [sys.executable, "-m", "edgevpr", "run", "--config", str(config), *self._plan.words]
        with open(self._folder / "edgevpr.txt", "w", encoding="utf-8") as said:
            self._edgevpr = subprocess.Popen(command, stdout=said, stderr=said, env=ground.environment())

    def end_edgevpr(self) -> int | None:
        """Ask edgevpr to end; return its exit status."""
        if self._edgevpr is None:
            return None
        self._edgevpr.terminate()
        try:
            return self._edgevpr.wait(15)
        except subprocess.TimeoutExpired:
            self._edgevpr.kill()
            return self._edgevpr.wait()

    def report(self) -> dict[str, Any]:
        """End edgevpr, and return what is not in the other files of the run."""
        status = self.end_edgevpr()
        self.recorder.close()
        return {
            "scenario": self._plan.name,
            "is_control": self._plan.is_control,
            "rate_hz": self._plan.rate_hz,
            "words": self._plan.words,
            "commit": base.commit(),
            "marks_s": self.marks_s,
            "edgevpr_exit": status,
            "texts": self.recorder.texts,
            "companion": self.recorder.companion,
            "values": self.recorder.values,
        }

    def _config(self) -> dict[str, Any]:
        source = {"uri": self._camera.uri, "camera": "nadir", "rate_hz": self._plan.rate_hz, "fov_deg": ground.FOV_DEG}
        link = {"link": f"tcp:127.0.0.1:{self._relay.port}", "min_accuracy_m": 1.0}
        config: dict[str, Any] = {
            "map": str(self._map),
            "source": source,
            "mavlink": link,
            "log": {"path": str(self._folder / "flight.jsonl")},
        }
        if self._scenario.learns:
            config |= {"technique": "cohog", "mapping": {"learn": True}}
        for room, keys in self._scenario.config.items():
            config[room] = {**config.get(room, {}), **keys}
        return config

    def _take_off(self) -> None:
        simulator = self._simulator
        simulator.wait_ready()
        if self._scenario.vehicle == "plane":
            simulator.link.upload(mission(HOME_M, CLIMB_M, CIRCUIT_M, HEIGHT_M))
            simulator.arm("AUTO")
        else:
            simulator.arm("GUIDED")
            simulator.link.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, HEIGHT_M)
        simulator.wait_height(0.95 * HEIGHT_M)
        self._say("at height")

    def _lose(self) -> None:
        scenario, simulator = self._scenario, self._simulator
        self._say("the loss")
        self.marks_s["loss"] = time.monotonic()
        if scenario.loses_gps:
            simulator.set_gps(False)
        if scenario.wind_m_s:
            simulator.set_wind(WIND_FROM_DEG, scenario.wind_m_s)
        if scenario.source_set and (scenario.parameters or not self._plan.is_control):
            simulator.link.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, scenario.source_set)

    def _reboot(self) -> None:
        self._say("reboot")
        self.recorder.is_on = False
        self._simulator.kill()
        time.sleep(_RETURN_S)
        self._simulator.start(wipe=False)
        self.marks_s["back"] = time.monotonic()
        heard = self._simulator.link.wait_for(f"HEARTBEAT of {COMPANION}", lambda _: True, 60)
        self.marks_s["heard_again"] = time.monotonic() if heard else float("nan")
        self._simulator.set_gps(True)
        self._simulator.set_wind(WIND_FROM_DEG, 0.0)
        self._take_off()
        self.recorder.is_on = True

    def _watch(self, seconds: float) -> None:
        """Let the flight go on for so long; a copter is steered meanwhile, and ends where it has landed."""
        began_s = said_s = time.monotonic()
        while (now_s := time.monotonic()) < began_s + seconds:
            if self._scenario.vehicle == "copter" and self._steer():
                return
            if self._scenario.glitch_m_s and "loss" in self.marks_s:
                self._glitch(now_s - self.marks_s["loss"])
            if now_s - said_s >= _SAID_EVERY_S:
                said_s = now_s
                self._say(f"{now_s - began_s:.0f} s")
            time.sleep(_STEP_S)

    def _steer(self) -> bool:
        """Send a copter on towards the next corner as a pilot who sees it would, by velocity; tell whether it has
        landed."""
        at = self.truth.at(time.monotonic())
        if at is None:
            return False
        east_m, north_m = COPTER_CIRCUIT_M[self._corner % len(COPTER_CIRCUIT_M)]
        east_m, north_m = east_m - at.east_m, north_m - at.north_m
        away_m = max((east_m**2 + north_m**2) ** 0.5, 0.1)
        if away_m < 3 * COPTER_SPEED_M_S:
            self._corner += 1
        east, north = (COPTER_SPEED_M_S * each / away_m for each in (east_m, north_m))
        down = max(-2.0, min(2.0, 0.5 * (at.height_m - HEIGHT_M)))
        frame = mavlink.MAV_FRAME_LOCAL_NED
        self._simulator.link.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, 1, 1, frame, _ONLY_VELOCITY, 0, 0, 0, north, east, down, 0, 0, 0, 0, 0
            )
        )
        return at.height_m < 1.0

    def _glitch(self, since_s: float) -> None:
        north_deg = self._scenario.glitch_m_s * since_s / _EARTH_DEGREE_M
        self._simulator.link.put_parameter("SIM_GPS1_GLTCH_X", north_deg)

    def _say(self, what: str) -> None:
        print(f"{self._plan.folder.name}: {what}: {self.recorder.line()}", file=sys.stderr, flush=True)
