"""PX4's own simulator (SIH) as a process, with the same interface as that of ArduPilot in simulator.py."""

import os
import socket
import time
from pathlib import Path

from link import Link, Listener
from relay import DatagramRelay
from scenarios import COPTER_CIRCUIT_M, COPTER_HOME_M, COPTER_SPEED_M_S, HOME_M
from simulator import Process, make_mission_items, to_degrees
from truth import Truth

from edgevpr.mavlink.wire import Message, mavlink

VARIABLE = "EDGEVPR_PX4"
# Ports of instance 0; each next instance adds 1. PX4 listens for the rig; it sends to edgevpr, and listens to it.
_GCS_PORT = 18570
_COMPANION_PORTS = (14540, 14580)
GROUND_ALT_M = 1.0  # of the simulated ground: a plane's height control starts at an altitude of 0 and ramps from there
# Parameters for an endless mission without a transmitter.
PARAMETERS = {
    "COM_RCL_EXCEPT": 15,
    "NAV_RCL_ACT": 0,
    "NAV_DLL_ACT": 0,
    "MIS_TKO_LAND_REQ": 1,
    "COM_LOW_BAT_ACT": 0,
    "SIM_BAT_DRAIN": 0,
    "SDLOG_MODE": -1,
}
# The airframe of 1.18 sets its thrust by a parameter that the simulator no longer reads; with 2 N it cannot take off.
_VEHICLE_PARAMETERS = {"plane": {"SIH_F_T_MAX": 6.0, "SIH_F_Q_MAX": 0.03}, "copter": {}}
_MODELS = {"plane": "sihsim_airplane", "copter": "sihsim_quadx"}
_AUTO_MODE = 4
_MISSION_MODE = 4  # sub-mode of AUTO
MODES = {f"AUTO.{name}": _AUTO_MODE << 16 | number << 24 for name, number in (("MISSION", 4), ("RTL", 5), ("LAND", 6))}
MODES |= {"AUTO.LOITER": _AUTO_MODE << 16 | 3 << 24, "DESCEND": 4 << 16 | 10 << 24}
_STREAMS_HZ = {
    mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION: 50,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 5,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5,
}
_CIRCUIT_M = ((340.0, 730.0), (1060.0, 730.0), (1060.0, 260.0), (340.0, 260.0))


def find_build() -> Path | None:
    """Return the folder of the PX4 build in EDGEVPR_PX4, or None if it has no build."""
    folder = Path(os.environ.get(VARIABLE, ""))
    return folder.resolve() if (folder / "bin/px4").exists() else None


class Px4(Process):
    """A PX4 that runs within the `with` block, from `home_m` (metres east and north). Several can run at the same time
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
        super().__init__(folder, listeners)
        self._vehicle, self._instance = vehicle, instance
        lat_deg, lon_deg = to_degrees(*home_m)
        home = {"PX4_HOME_LAT": f"{lat_deg:.7f}", "PX4_HOME_LON": f"{lon_deg:.7f}", "PX4_HOME_ALT": str(GROUND_ALT_M)}
        model = {"PX4_SIMULATOR": "sihsim", "PX4_SIM_MODEL": _MODELS[vehicle], "HEADLESS": "1"}
        parameters = PARAMETERS | _VEHICLE_PARAMETERS[vehicle] | parameters | {"MAV_SYS_ID": 1}
        variables = {f"PX4_PARAM_{name}": str(value) for name, value in parameters.items()}
        self._environment = {**os.environ, **home, **model, **variables}

    def start(self, *, wipe: bool) -> None:
        build = find_build()
        command = [build / "bin/px4", "-i", self._instance, "-d", build / "etc", "-w", self._folder]
        self._launch(command, self._environment)
        gcs_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        gcs_socket.connect(("127.0.0.1", _GCS_PORT + self._instance))
        self._connect(Link(gcs_socket, self._listeners, bytewise=True), _STREAMS_HZ)

    def make_relay(self, truth: Truth, log: Path, origin_m: tuple[float, float]) -> DatagramRelay:
        """Return the relay between this PX4 and edgevpr."""
        return DatagramRelay(truth, log, tuple(port + self._instance for port in _COMPANION_PORTS), origin_m)

    def take_off(self, height_m: float, items: list[Message] | None = None) -> None:
        """Start a mission (None: endless laps of a circuit) and wait until the aircraft is at `height_m`. Raises
        RuntimeError if it does not arm or does not reach the height."""
        self.wait_ready()
        self.link.upload_mission(items or _make_mission(self._vehicle, height_m))
        flag = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        self.link.command(mavlink.MAV_CMD_DO_SET_MODE, flag, _AUTO_MODE, _MISSION_MODE)
        self._arm()
        self.wait_height(0.95 * height_m)

    def set_gps(self, is_on: bool) -> None:
        self.set_satellites(10 if is_on else 0)

    def set_satellites(self, count: int) -> None:
        self.link.set_parameter("SIM_GPS_USED", count)

    def displace_gps(self, north_m: float) -> None:
        """Displace the receiver's positions to the north. Needs a parameter that README.md describes."""
        self.link.send_parameter("SIM_GPS_OFF_N", round(2 * north_m) / 2)  # PX4 stops if it changes while it is saved

    def set_wind(self, from_deg: float, speed_m_s: float) -> None:
        if from_deg != 270.0:
            raise ValueError("PX4's simulator is only used with wind from the west")
        self.link.set_parameter("SIH_WIND_E", float(speed_m_s))

    def wait_ready(self) -> None:
        give_up_s = time.monotonic() + 120
        while time.monotonic() < give_up_s:
            filter_, gps, status = (self.link.last.get(n) for n in ("ESTIMATOR_STATUS", "GPS_RAW_INT", "SYS_STATUS"))
            if filter_ and gps and status:
                is_placed = filter_.flags & mavlink.ESTIMATOR_POS_HORIZ_ABS and gps.fix_type >= 3
                if is_placed and status.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK:
                    return
            time.sleep(0.1)
        raise RuntimeError("PX4 was not ready within 120 s")


def _make_mission(vehicle: str, height_m: float) -> list[Message]:
    """Return the items of a mission: take-off, then endless laps of a circuit."""
    takeoff, waypoint, jump = mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_CMD_DO_JUMP
    no_values = (0, 0, 0, float("nan"))
    if vehicle == "plane":
        rows = [(takeoff, no_values, (HOME_M[0], HOME_M[1] + 320), 0.6 * height_m)]
        rows += [(waypoint, no_values, corner_m, height_m) for corner_m in _CIRCUIT_M]
        rows += [(jump, (1, -1, 0, 0), None, 0)]
    else:
        rows = [(takeoff, no_values, COPTER_HOME_M, height_m)]
        rows += [(mavlink.MAV_CMD_DO_CHANGE_SPEED, (1, COPTER_SPEED_M_S, -1, 0), None, 0)]
        rows += [(waypoint, no_values, corner_m, height_m) for corner_m in COPTER_CIRCUIT_M]
        rows += [(jump, (2, -1, 0, 0), None, 0)]
    return make_mission_items(rows)
