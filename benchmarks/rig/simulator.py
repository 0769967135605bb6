"""ArduPilot's simulator as a process, with the actions that scenarios need."""

import contextlib
import os
import signal
import socket
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

from ground import GROUND_ALT_M
from link import STREAMS_HZ, Link, Listener, connect
from relay import Relay
from scenarios import CIRCUIT_M, CLIMB_M, HOME_M
from truth import Truth

from edgevpr.lab.simulate.camera import CameraPose
from edgevpr.lab.simulate.generated import to_position
from edgevpr.mavlink.wire import Message, mavlink

VARIABLE = "EDGEVPR_ARDUPILOT"
_PORTS = 5760, 5762, 5763  # for the rig, for edgevpr, and unused; each next instance adds 10


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle of ArduPilot: binary, model of its physics, file of default parameters, and numbers of its modes."""

    binary: str
    model: str
    defaults: str
    modes: dict[str, int]


_PLANE_MODES = {"CIRCLE": 1, "AUTO": 10, "RTL": 11, "LOITER": 12, "TAKEOFF": 13, "GUIDED": 15}
VEHICLES = {
    "plane": Vehicle("arduplane", "plane", "models/plane.parm", _PLANE_MODES),
    "copter": Vehicle(
        "arducopter", "quad", "default_params/copter.parm", {"ALT_HOLD": 2, "GUIDED": 4, "RTL": 6, "LAND": 9}
    ),
}


def find_build(vehicle: str = "plane") -> Path | None:
    """Return the ArduPilot folder in EDGEVPR_ARDUPILOT, or None if that vehicle is not built there."""
    folder = Path(os.environ.get(VARIABLE, ""))
    return folder.resolve() if (folder / "build/sitl/bin" / VEHICLES[vehicle].binary).exists() else None


def to_degrees(east_m: float, north_m: float) -> tuple[float, float]:
    """Return latitude and longitude of a position on the ground, metres east and north."""
    position = to_position(CameraPose(east_m=east_m, north_m=north_m, height_m=0.0, heading_deg=0.0))
    return position.lat_deg, position.lon_deg


class Process:
    """A simulator process in its own folder, within the `with` block; `listeners` receive every message of its link."""

    def __init__(self, folder: Path, listeners: list[Listener]) -> None:
        self._folder, self._listeners = folder, listeners
        self._process: subprocess.Popen | None = None
        self.link: Link | None = None

    def __enter__(self):
        self._folder.mkdir(parents=True)
        try:
            self.start(wipe=True)
        except BaseException:
            self.kill()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def start(self, *, wipe: bool) -> None:
        """Start the process and connect to it; with `wipe`, without the parameters saved by earlier starts."""
        raise NotImplementedError

    def _launch(self, command: list, environment: dict[str, str]) -> None:
        with open(self._folder / "simulator.txt", "ab") as output:
            streams = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
            self._process = subprocess.Popen(
                [*map(str, command)], cwd=self._folder, env=environment, start_new_session=True, **streams
            )

    def _connect(self, link: Link, streams_hz: dict[int, float]) -> None:
        """Store the link, and request messages at these rates (by message id)."""
        self.link = link
        if not self.link.wait_for("HEARTBEAT", lambda _: True, 30):
            raise RuntimeError(f"no heartbeat from the simulator: see {self._folder}/simulator.txt")
        for number, rate_hz in streams_hz.items():
            self.link.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / rate_hz)

    def _arm(self) -> None:
        for _ in range(30):
            if self.link.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == mavlink.MAV_RESULT_ACCEPTED:
                return
            time.sleep(1)
        raise RuntimeError("the autopilot does not arm")

    def wait_height(self, height_m: float) -> None:
        """Wait until the aircraft is at `height_m`. Raises RuntimeError after three minutes."""
        if not self.link.wait_for("GLOBAL_POSITION_INT", lambda message: message.relative_alt > 1000 * height_m, 180):
            raise RuntimeError(f"the aircraft did not reach {height_m:.0f} m")

    def kill(self) -> None:
        """Kill the process, as a loss of power would."""
        if self.link:
            self.link.close()
        if self._process:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self.link = self._process = None


class Simulator(Process):
    """ArduPilot's simulator; the vehicle starts at `home_m`, metres east and north. Several can run at the same time
    with different `instance` numbers."""

    ground_alt_m = GROUND_ALT_M

    def __init__(
        self,
        vehicle: str,
        folder: Path,
        home_m: tuple[float, float],
        parameters: dict,
        listeners: list[Listener],
        instance: int = 0,
    ) -> None:
        self.vehicle = VEHICLES[vehicle]
        super().__init__(folder, listeners)
        self._name, self._instance = vehicle, instance
        self._ports = [port + 10 * instance for port in _PORTS]
        self._parameters = parameters
        self._home = "{:.7f},{:.7f},{:.0f},90".format(*to_degrees(*home_m), GROUND_ALT_M)

    def __enter__(self) -> "Simulator":
        try:
            socket.create_server(("", self._ports[2])).close()
        except OSError:
            raise RuntimeError("another simulator runs on this machine; stop it first") from None
        return super().__enter__()

    def start(self, *, wipe: bool) -> None:
        parameter_file = self._folder / "rig.parm"
        parameter_file.write_text("".join(f"{name} {value}\n" for name, value in self._parameters.items()))
        folder = find_build(self._name)
        defaults = folder / "Tools/autotest" / self.vehicle.defaults
        command = [folder / "build/sitl/bin" / self.vehicle.binary, "--model", self.vehicle.model, "--speedup", "1"]
        command += ["--home", self._home, "--sim-address", "127.0.0.1", f"-I{self._instance}"]
        command += ["--defaults", f"{defaults},{parameter_file}", *(["--wipe"] if wipe else [])]
        self._launch(command, dict(os.environ))
        self._connect(Link(connect(self._ports[0]), self._listeners), STREAMS_HZ)

    def make_relay(self, truth: Truth, log: Path, origin_m: tuple[float, float]) -> Relay:
        """Return the relay between this autopilot and edgevpr."""
        return Relay(truth, log, self._ports[1], origin_m)

    def wait_ready(self) -> None:
        """Wait until the autopilot has a position and is ready to arm. Raises RuntimeError after three minutes."""
        attitude_and_position = mavlink.EKF_ATTITUDE | mavlink.EKF_POS_HORIZ_ABS
        give_up_s = time.monotonic() + 180
        while time.monotonic() < give_up_s:
            ekf, status = (self.link.last.get(name) for name in ("EKF_STATUS_REPORT", "SYS_STATUS"))
            if ekf and status and ekf.flags & attitude_and_position == attitude_and_position:
                health = status.onboard_control_sensors_health
                if health & mavlink.MAV_SYS_STATUS_PREARM_CHECK and not ekf.flags & mavlink.EKF_UNINITIALIZED:
                    return
            time.sleep(0.1)
        raise RuntimeError("the autopilot was not ready within 180 s")

    def arm(self, mode: str) -> None:
        """Set the mode and arm. Raises RuntimeError if the autopilot refuses to arm."""
        self.set_mode(mode)
        self._arm()

    def set_mode(self, mode: str) -> None:
        number = self.vehicle.modes[mode]
        self.link.command(mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, number)

    def set_gps(self, is_on: bool) -> None:
        self.link.set_parameter("SIM_GPS1_ENABLE", int(is_on))

    def set_satellites(self, count: int) -> None:
        self.link.set_parameter("SIM_GPS1_NUMSATS", count)

    def displace_gps(self, north_m: float) -> None:
        """Displace the receiver's positions to the north of the truth."""
        north_deg = to_degrees(0.0, north_m)[0] - to_degrees(0.0, 0.0)[0]
        self.link.send_parameter("SIM_GPS1_GLTCH_X", north_deg)

    def set_wind(self, from_deg: float, speed_m_s: float) -> None:
        self.link.set_parameter("SIM_WIND_DIR", from_deg)
        self.link.set_parameter("SIM_WIND_SPD", speed_m_s)


def make_mission(height_m: float) -> list[Message]:
    """Return the items of a plane's mission: take-off, then endless laps of a circuit."""
    takeoff, waypoint, jump = mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_CMD_DO_JUMP
    no_values = (0, 0, 0, 0)
    rows = [(waypoint, no_values, HOME_M, 0.0), (takeoff, (12, 0, 0, 0), CLIMB_M, 0.6 * height_m)]
    rows += [(waypoint, no_values, corner_m, height_m) for corner_m in CIRCUIT_M]
    return make_mission_items([*rows, (jump, (2, -1, 0, 0), None, 0)])


def make_mission_items(rows) -> list[Message]:
    """Return mission items, of rows (command, its first four values, (east, north) or None, height in metres)."""
    items = []
    for number, (command, values, at_m, up_m) in enumerate(rows):
        lat, lon = (round(1e7 * degrees) for degrees in to_degrees(*at_m)) if at_m else (0, 0)
        frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT if at_m else mavlink.MAV_FRAME_MISSION
        fields = (number, frame, command, int(number == 0), 1, *values, lat, lon, up_m)
        items.append(mavlink.MAVLink_mission_item_int_message(1, 1, *fields))
    return items
