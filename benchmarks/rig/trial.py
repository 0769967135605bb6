"""One flight of the sweep: the aircraft hovers, circles or flies a leg while the steps of an event are carried out."""

import json
import math
import shutil
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import base
import ground
from cells import CENTRE_M, EVENTS, LEG_M, RADIUS_M, SET_UPS, WATCH_S, Flight
from flying import LOOP_STEP_S, Run
from recording import EDGEVPR
from scenarios import HEIGHT_M
from simulator import make_mission_items, to_degrees

from edgevpr.mavlink.wire import mavlink

_SETTLE_S = 10.0
_POWER_OFF_S = 6.0
_PARAMETER_REQUESTS_S = 10.0  # edgevpr has requested all parameters by then
_PARAMETER_SAVE_S = 3.0  # a parameter is stored by then and survives a loss of power
_CIRCLE_ENTRY_S = 40.0  # longest time until a plane is on its circle
_CIRCLE_POINTS = 72  # corners of the planned path
_PAUSE_REQUEST = 1  # first parameter of MAV_CMD_USER_1, as edgevpr defines it


class Trial(Run):
    """A flight of the table. The actions of steps are methods; those that need edgevpr or its relay are skipped in a
    control flight without edgevpr."""

    def __init__(self, work: Path, folder: Path, flight: Flight, instance: int) -> None:
        super().__init__(work, folder, flight.make_scenario(), not flight.has_edgevpr, instance)
        self._flight, self._event = flight, EVENTS[flight.event]
        self._repeated_actions: dict[str, Callable[[float], object]] = {}

    def fly(self) -> Path:
        """Make the flight and return its folder. If the aircraft cannot fly, run.json has the reason as `cannot`."""
        failure = None
        with ExitStack() as stack:
            try:
                self._equip(stack)
                self._recorder.is_on = True
                self._start_edgevpr()
                for action, values in self._event.before:
                    self._run_action(action, values)
                self._marks_s["started"] = time.monotonic()
                self._simulator.wait_ready()
                self._take_off()
                self._wait_settled()
                self._run_event(WATCH_S)
                self._wait_pose()  # raises if the simulator has ended early
            except RuntimeError as error:
                failure = str(error)
            self._recorder.is_on = False
        run = {
            "commit": base.read_program_commit(ground.CHECKOUT),
            "cannot": failure,
            "marks_s": self._marks_s,
            "path_m": getattr(self, "_path_m", None),
            "texts": self._recorder.texts,
            "warnings": self._recorder.warnings,
        }
        (self._folder / "run.json").write_text(json.dumps(run))
        shutil.rmtree(self._folder / "simulator", ignore_errors=True)  # its logs are large
        return self._folder

    def _take_off(self) -> None:
        simulator, is_plane = self._simulator, self._scenario.vehicle == "plane"
        if self._scenario.is_px4:
            rows = [(mavlink.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, math.nan), self._scenario.home_m, HEIGHT_M)]
            if is_plane:
                east_m, north_m = self._scenario.home_m
                circle = (mavlink.MAV_CMD_NAV_LOITER_UNLIM, (0, 0, RADIUS_M, math.nan), CENTRE_M, HEIGHT_M)
                rows = [(*rows[0][:2], (east_m, north_m + 320), 0.6 * HEIGHT_M), circle]
            simulator.take_off(HEIGHT_M, make_mission_items(rows))
        elif is_plane:
            simulator.arm("TAKEOFF")
            simulator.wait_height(50.0)
            simulator.set_mode("GUIDED")
            self._go_to(CENTRE_M)
            simulator.wait_height(HEIGHT_M - 3.0)
        else:
            simulator.arm("GUIDED")
            simulator.link.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, HEIGHT_M)
            simulator.wait_height(HEIGHT_M - 1.0)

    def _wait_settled(self) -> None:
        """Wait until the aircraft hovers or is on its circle, and store the path that it should follow."""
        give_up_s = time.monotonic() + _CIRCLE_ENTRY_S
        is_plane = self._scenario.vehicle == "plane"
        while is_plane and time.monotonic() < give_up_s and abs(self._measure_radius_m() - RADIUS_M) > 40.0:
            time.sleep(LOOP_STEP_S)
        time.sleep(_SETTLE_S)
        if is_plane:
            radius_m = self._measure_radius_m()
            angles = [2 * math.pi * number / _CIRCLE_POINTS for number in range(_CIRCLE_POINTS + 1)]
            self._path_m = [
                (CENTRE_M[0] + radius_m * math.cos(angle), CENTRE_M[1] + radius_m * math.sin(angle)) for angle in angles
            ]
        else:
            pose = self._wait_pose()
            start_m = pose.east_m, pose.north_m
            self._path_m = [start_m, LEG_M[1] if self._event.leaves_map else start_m]

    def _wait_pose(self):
        """Return the true pose now. Raises ChildProcessError if there is none for some seconds: this is no flight."""
        for _ in range(50):
            if pose := self._truth.compute_pose(time.monotonic()):
                return pose
            time.sleep(LOOP_STEP_S)
        raise ChildProcessError("the simulator has stopped")

    def _measure_radius_m(self) -> float:
        pose = self._wait_pose()
        return math.hypot(pose.east_m - CENTRE_M[0], pose.north_m - CENTRE_M[1])

    def _run_event(self, seconds: float) -> None:
        """Carry out the steps of the event when they are due, for `seconds`."""
        began_s = self._marks_s["event"] = time.monotonic()
        if self._event.leaves_map and self._scenario.vehicle == "copter":
            self._go_to(LEG_M[1])
        steps = list(self._event.steps)
        while (now_s := time.monotonic()) < began_s + seconds:
            while steps and now_s >= began_s + steps[0].at_s:
                step = steps.pop(0)
                self._run_action(step.action, step.values)
            for action in list(self._repeated_actions.values()):
                action(now_s)
            time.sleep(LOOP_STEP_S)

    def _go_to(self, at_m: tuple[float, float]) -> None:
        lat, lon = (round(1e7 * degrees) for degrees in to_degrees(*at_m))
        values = (0, 0, -1, 1, RADIUS_M if self._scenario.vehicle == "plane" else 0, math.nan, lat, lon)
        up_m, frame = HEIGHT_M, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
        if self._scenario.is_px4:  # PX4 only accepts an altitude in this command
            up_m, frame = self._simulator.link.last["GLOBAL_POSITION_INT"].alt / 1e3, mavlink.MAV_FRAME_GLOBAL
        command = mavlink.MAV_CMD_DO_REPOSITION
        self._simulator.link.send(mavlink.MAVLink_command_int_message(1, 1, frame, command, *values, up_m))

    def _await_edgevpr(self) -> None:
        """Wait until edgevpr has started and has had time to request parameters."""
        if not self._is_control and not self._simulator.link.wait_for(f"HEARTBEAT of {EDGEVPR}", lambda _: True, 60):
            raise RuntimeError("edgevpr did not start within 60 s")
        time.sleep(_PARAMETER_REQUESTS_S)

    def _run_action(self, action: str, values: tuple[float, ...]) -> None:
        self._marks_s.setdefault(action, time.monotonic())
        if action not in _EDGEVPR_ACTIONS or not self._is_control:
            getattr(self, action)(*values)

    # Actions on the autopilot and its receiver

    def set_gps(self, is_on: float) -> None:
        self._simulator.set_gps(bool(is_on))

    def set_satellites(self, count: float) -> None:
        self._simulator.set_satellites(int(count))

    def displace_gps(self, north_m: float) -> None:
        self._simulator.displace_gps(north_m)

    def drift_gps(self, speed_m_s: float) -> None:
        began_s = time.monotonic()
        self._repeated_actions["drift"] = lambda now_s: self._simulator.displace_gps(speed_m_s * (now_s - began_s))

    def flag_gps(self, state: float) -> None:
        self._simulator.link.set_parameter("SIM_GPS_SPOOF", int(state))

    def use_gps(self, bits: float) -> None:
        self._simulator.link.set_parameter("EKF2_GPS_CTRL", int(bits))

    def choose_sources(self, number: float) -> None:
        self._simulator.link.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, number)

    def set_home(self, up_m: float) -> None:
        """Set the home position to `up_m` above the ground at its old position."""
        position = *to_degrees(*self._scenario.home_m), self._simulator.ground_alt_m + up_m
        self._simulator.link.command(mavlink.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, *position)

    def set_origin(self, east_m: float, up_m: float) -> None:
        """Set the origin of the local frame to `east_m` east of the start and `up_m` above the ground."""
        home_east_m, home_north_m = self._scenario.home_m
        lat, lon = (round(1e7 * degrees) for degrees in to_degrees(home_east_m + east_m, home_north_m))
        alt_mm = round(1000 * (self._simulator.ground_alt_m + up_m))
        self._simulator.link.send(mavlink.MAVLink_set_gps_global_origin_message(1, lat, lon, alt_mm))

    def reboot(self) -> None:
        """Switch the autopilot off and on again; it keeps its parameters."""
        self._await_edgevpr()
        self._simulator.kill()
        time.sleep(_POWER_OFF_S)
        self._simulator.start(wipe=False)

    # Actions on edgevpr and its relay

    def adopt(self) -> None:
        """Set the parameters of the set-up on the autopilot, as `edgevpr doctor` advises."""
        self._await_edgevpr()
        for name, value in SET_UPS[self._flight.set_up].parameters.items():
            self._simulator.link.set_parameter(name, value)
        time.sleep(_PARAMETER_SAVE_S)

    def lose_requests(self, seconds: float) -> None:
        """Lose all parameter requests from the first one until `seconds` later."""
        requests_s: list[float] = []

        def is_lost(message) -> bool:
            if message.get_type() != "PARAM_REQUEST_READ":
                return False
            requests_s.append(time.monotonic())
            return requests_s[-1] < requests_s[0] + seconds

        self._relay.drops = is_lost

    def restart_edgevpr(self, clock_s: float | None = None) -> None:
        """Kill and start edgevpr, with its monotonic clock set to `clock_s` as after a reboot (None: unchanged)."""
        self._edgevpr.kill()
        self._edgevpr.wait()
        self._edgevpr = None
        self._start_edgevpr(clock_s)

    def stop_edgevpr(self, seconds: float) -> None:
        """Stop the process of edgevpr for `seconds`, as if the CPU were busy."""
        resume_s = time.monotonic() + seconds
        self._edgevpr.send_signal(signal.SIGSTOP)

        def resume(now_s: float) -> None:
            if now_s >= resume_s:
                self._edgevpr.send_signal(signal.SIGCONT)
                del self._repeated_actions["stopped"]

        self._repeated_actions["stopped"] = resume

    def freeze(self, is_frozen: float) -> None:
        self._camera.is_frozen = bool(is_frozen)

    def pause(self) -> None:
        request = (1, EDGEVPR, mavlink.MAV_CMD_USER_1, 0, _PAUSE_REQUEST, 0, 0, 0, 0, 0, 0)
        self._simulator.link.send(mavlink.MAVLink_command_long_message(*request))

    def saturate(self, bytes_per_s: float) -> None:
        self._relay.saturate(bytes_per_s)

    def send_other_stamps(self) -> None:
        """Send messages of another program, whose time stamps are in UTC instead of time since boot."""
        packer = mavlink.MAVLink(None, 1, 198)

        def send(_now_s: float) -> None:
            values = (round(time.time() * 1e6), 0, mavlink.MAV_FRAME_BODY_FRD, 0.1, 0.1, 20.0, 0.0, 0.0)
            self._relay.inject(mavlink.MAVLink_landing_target_message(*values).pack(packer), to_edgevpr=True)

        self._repeated_actions["stamps"] = send


_EDGEVPR_ACTIONS = frozenset(
    ("adopt", "lose_requests", "restart_edgevpr", "stop_edgevpr", "freeze", "pause", "saturate", "send_other_stamps")
) | {"choose_sources"}  # the control has only one source set
