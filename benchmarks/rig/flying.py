"""One run of a scenario with the simulator, the camera, and edgevpr between them, recorded in a folder."""

import json
import math
import shutil
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import base
import ground
from camera import Camera
from px4 import GROUND_ALT_M, Px4
from recording import Recorder
from scenarios import (
    COPTER_CIRCUIT_M,
    COPTER_HOME_M,
    COPTER_SPEED_M_S,
    HOME_M,
    VEHICLE_PARAMETERS,
    WIND_FROM_DEG,
    Scenario,
    parse_flight_name,
)
from simulator import Simulator, make_mission
from truth import Truth

from edgevpr.mavlink.wire import mavlink

LOOP_STEP_S = 0.1
_SHIFTED_CLOCK_SCRIPT = (
    "import runpy, time; clock, shift = time.monotonic, {} - time.monotonic(); "
    "time.monotonic = lambda: clock() + shift; runpy.run_module('edgevpr', None, '__main__')"
)
_VELOCITY_MASK = 0b0000110111000111  # of SET_POSITION_TARGET_LOCAL_NED: ignore position, acceleration and yaw


class Run:
    """A run of a scenario in the simulator number `instance`, with edgevpr unless it `is_control`. `fly` makes the run
    and returns the folder of its files."""

    def __init__(self, work: Path, folder: Path, scenario: Scenario, is_control: bool, instance: int = 0) -> None:
        self._work, self._scenario, self._is_control = work, scenario, is_control
        self._folder, self._instance = folder, instance
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(parents=True)
        self._truth = Truth(GROUND_ALT_M if scenario.is_px4 else ground.GROUND_ALT_M)
        self._recorder = Recorder(self._truth, self._folder / "track.csv")
        self._edgevpr: subprocess.Popen | None = None
        self._marks_s: dict[str, float] = {}
        self._corner = 0

    def fly(self) -> Path:
        """Fly the scenario. Raises RuntimeError if the flight fails, for example if the autopilot does not arm."""
        with ExitStack() as stack:
            self._equip(stack)
            if self._scenario.starts_early:
                self._start_edgevpr()
            self._take_off()
            self._start_edgevpr()
            self._watch(self._scenario.gps_s)
            self._remove_gps()
            self._watch(self._scenario.off_s)
        run = {"commit": base.read_commit(ground.CHECKOUT), "marks_s": self._marks_s, "texts": self._recorder.texts}
        (self._folder / "run.json").write_text(json.dumps(run))
        return self._folder

    def _equip(self, stack: ExitStack) -> None:
        """Start the simulator, the camera and the relay to the autopilot, and write edgevpr's configuration."""
        scenario, folder = self._scenario, self._folder
        home_m = scenario.home_m or (COPTER_HOME_M if scenario.vehicle == "copter" else HOME_M)
        parameters = {**({} if scenario.is_px4 else VEHICLE_PARAMETERS[scenario.vehicle]), **scenario.parameters}
        parameters |= {} if self._is_control else scenario.with_edgevpr
        listeners = [self._truth.handle_message, self._recorder.handle_message]
        kind = Px4 if scenario.is_px4 else Simulator
        stack.callback(self._recorder.close)
        simulator = kind(scenario.vehicle, folder / "simulator", home_m, parameters, listeners, self._instance)
        self._simulator = stack.enter_context(simulator)
        if not self._is_control:
            lit_ground = ground.load_ground(self._work, "later")
            seed = ground.SEED + parse_flight_name(folder.name)[1]
            self._camera = stack.enter_context(Camera(self._truth, lit_ground, folder / "pictures.csv", seed, scenario))
            self._relay = stack.enter_context(simulator.make_relay(self._truth, folder / "sent.csv", home_m))
            config = self._make_config(self._prepare_map(), self._camera.uri, self._relay.uri)
            (folder / "config.yaml").write_text(json.dumps(config, indent=1))  # JSON is YAML
        stack.callback(self._end_edgevpr)

    def _prepare_map(self) -> Path:
        """Return the map of the ground, moved to the altitude of the simulator's ground."""
        scenario = self._scenario
        place_map = ground.build_place_map(self._work, scenario.height_m, scenario.mapped_m)
        up_m = GROUND_ALT_M - ground.GROUND_ALT_M if scenario.is_px4 else 0.0
        return ground.move_map(place_map, scenario.map_east_m, up_m)

    def _start_edgevpr(self, clock_s: float | None = None) -> None:
        """Start edgevpr, unless it runs or this is a control; `clock_s` sets its monotonic clock (None: unchanged)."""
        if self._is_control or self._edgevpr:
            return
        module = ["-m", "edgevpr"]
        if clock_s is not None:
            module = ["-c", _SHIFTED_CLOCK_SCRIPT.format(clock_s)]
        command = [sys.executable, *module, "run", "--config", str(self._folder / "config.yaml")]
        with open(self._folder / "edgevpr.txt", "a", encoding="utf-8") as output:
            self._edgevpr = subprocess.Popen(command, stdout=output, stderr=output, env=ground.make_environment())

    def _end_edgevpr(self) -> None:
        if self._edgevpr:
            self._edgevpr.terminate()
            try:
                self._edgevpr.wait(15)
            except subprocess.TimeoutExpired:
                self._edgevpr.kill()
                self._edgevpr.wait()

    def _make_config(self, place_map: Path, uri: str, link: str) -> dict[str, Any]:
        config: dict[str, Any] = {
            "map": str(place_map),
            "source": {"uri": uri, "camera": "nadir", "rate_hz": 1.0, "fov_deg": ground.FOV_DEG},
            "mavlink": {"link": link, "min_accuracy_m": 1.0},
            "log": {"path": str(self._folder / "flight.jsonl")},
        }
        for section, keys in self._scenario.config.items():
            config[section] = {**config.get(section, {}), **keys}
        return config

    def _take_off(self) -> None:
        simulator = self._simulator
        if self._scenario.is_px4:
            simulator.take_off(self._scenario.height_m)
            self._recorder.is_on = True
            return
        simulator.wait_ready()
        if self._scenario.vehicle == "plane":
            simulator.link.upload_mission(make_mission(self._scenario.height_m))
            simulator.arm("AUTO")
        else:
            simulator.arm("GUIDED")
            simulator.link.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, self._scenario.height_m)
        simulator.wait_height(0.95 * self._scenario.height_m)
        self._recorder.is_on = True

    def _remove_gps(self) -> None:
        """Record the time of the loss, and apply all changes of the scenario at that time: GPS, wind, source set."""
        scenario, simulator = self._scenario, self._simulator
        self._marks_s["loss"] = time.monotonic()
        if scenario.loses_gps:
            simulator.set_gps(False)
        if scenario.uses_no_gps:
            simulator.link.set_parameter("EKF2_GPS_CTRL", 0)
        if scenario.wind_m_s:
            simulator.set_wind(WIND_FROM_DEG, scenario.wind_m_s)
        if scenario.source_set and (scenario.parameters or not self._is_control):
            simulator.link.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, scenario.source_set)

    def _watch(self, seconds: float) -> None:
        """Continue the flight for `seconds`, while steering a copter; return early once a copter has landed."""
        began_s = time.monotonic()
        while (now_s := time.monotonic()) < began_s + seconds:
            if self._scenario.vehicle == "copter" and (self._has_landed() if self._scenario.is_px4 else self._steer()):
                return
            if self._scenario.glitch_m_s and "loss" in self._marks_s:
                north_m = self._scenario.glitch_m_s * (now_s - self._marks_s["loss"])
                self._simulator.displace_gps(north_m)
            time.sleep(LOOP_STEP_S)

    def _has_landed(self) -> bool:
        pose = self._truth.compute_pose(time.monotonic())
        return pose is not None and pose.height_m < 1.0

    def _steer(self) -> bool:
        """Steer a copter by velocity to the next corner, like a pilot who sees it; return True once it has landed."""
        pose = self._truth.compute_pose(time.monotonic())
        if pose is None:
            return False
        east_m, north_m = COPTER_CIRCUIT_M[self._corner % len(COPTER_CIRCUIT_M)]
        east_m, north_m = east_m - pose.east_m, north_m - pose.north_m
        distance_m = max(math.hypot(east_m, north_m), 0.1)
        if distance_m < 3 * COPTER_SPEED_M_S:
            self._corner += 1
        east, north = (COPTER_SPEED_M_S * offset_m / distance_m for offset_m in (east_m, north_m))
        down = max(-2.0, min(2.0, 0.5 * (pose.height_m - self._scenario.height_m)))
        target = (0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, _VELOCITY_MASK, 0, 0, 0, north, east, down, 0, 0, 0, 0, 0)
        self._simulator.link.send(mavlink.MAVLink_set_position_target_local_ned_message(*target))
        return pose.height_m < 1.0
