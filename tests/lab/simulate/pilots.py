"""A pilot at a flight controller: one for the simulated one, whose clock it turns, and one for a real ArduPilot."""

import math
import os
import signal
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path

from freeflight import Piloted
from loopback import PATIENCE_S

from edgevpr.core.geodesy import distance_m
from edgevpr.lab.simulate.generated import ORIGIN
from edgevpr.mavlink.messages import MotionState
from edgevpr.mavlink.wire import PacketReader, mavlink

ARDUPILOT = os.environ.get("EDGEVPR_ARDUPILOT")  # the folder of a built ArduPilot
PX4 = os.environ.get("EDGEVPR_PX4")  # the folder of a built PX4
_INSTANCE = 5
_SPEEDUP = 3
_REPORTS_HZ = {24: 5, 33: 10, 108: 10, 193: 10}  # GPS_RAW_INT, GLOBAL_POSITION_INT, SIM_STATE, EKF
_DEFAULTS = {"plane": "models/plane.parm", "copter": "default_params/copter.parm"}
_MODELS = {"plane": "plane", "copter": "quad"}
_QUIET = {"FS_GCS_ENABLE": 0, "TERRAIN_ENABLE": 0, "FS_GCS_ENABL": 0, "FS_LONG_ACTN": 0, "THR_FAILSAFE": 0}
FIX = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE


def state_at(t_mono_s, lat_deg, lon_deg, alt_m=600.0, velocity_m_s=(0.0, 0.0, 0.0), accuracy_m=1.0):
    """What edgevpr says of a position; velocity: east, north, down."""
    return MotionState(
        t_mono_s=t_mono_s,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_m=alt_m,
        velocity_m_s=velocity_m_s,
        accuracy_m=accuracy_m,
        alt_accuracy_m=1.0,
        speed_accuracy_m_s=0.3,
    )


class Pilot:
    """Flies over `port` (recv, send). Its clock is that of the flight controller."""

    def __init__(self, port) -> None:
        self._port = port
        self._receiver = PacketReader()
        self._packer = mavlink.MAVLink(None, 255, mavlink.MAV_COMP_ID_MISSIONPLANNER)
        self._beat_s = -math.inf
        self.now_s = 0.0
        self.last, self.heard, self.texts = {}, [], []
        self.on_truth = None  # called with every SIM_STATE
        self.truths = []  # time, lat_deg, lon_deg

    def send(self, message) -> None:
        self._port.send(message.pack(self._packer))
        self._packer.seq = (self._packer.seq + 1) % 256

    def read(self) -> None:
        if self.now_s - self._beat_s >= 1 or self._beat_s > self.now_s:
            self._beat_s = self.now_s
            self.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))
        for message in self._receiver.feed(self._port.recv(65_536)):
            if (message.get_srcSystem(), message.get_srcComponent()) != (1, 1):
                continue
            kind = message.get_type()
            self.now_s = max(self.now_s, getattr(message, "time_boot_ms", 0) / 1e3)
            self.last[kind] = message
            self.heard.append(message)
            if kind == "STATUSTEXT":
                self.texts.append(message.text)
            if kind == "SIM_STATE":
                self.truths.append((self.now_s, message.lat_int / 1e7, message.lon_int / 1e7))
                if self.on_truth:
                    self.on_truth(message)

    def until(self, condition, what: str, patience_s: float = 60.0):
        """Read until a condition holds, for so many seconds of the flight controller's clock at most."""
        end_s, give_up_s = self.now_s + patience_s, time.monotonic() + 4 * PATIENCE_S
        while self.now_s < end_s and time.monotonic() < give_up_s:
            if result := condition():
                return result
            self.read()
        raise AssertionError(f"{what}: not in {patience_s:g} s; {self.texts[-5:]}")

    def wait(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        self.until(lambda: self.now_s >= end_s, "time", seconds + 60)

    def next(self, kind: str, fits=lambda message: True, patience_s: float = 20.0):
        """Return the next message of a kind."""
        begin = len(self.heard)
        return self.until(
            lambda: next((each for each in self.heard[begin:] if each.get_type() == kind and fits(each)), None),
            kind,
            patience_s,
        )

    def answer(self, message) -> int:
        """Send a command; return the result in its answer."""
        self.send(message)
        return self.next("COMMAND_ACK", lambda ack: ack.command == message.command).result

    def command(self, number: int, *values: float) -> int:
        padded = [*values, *[0] * (7 - len(values))]
        return self.answer(mavlink.MAVLink_command_long_message(1, 1, number, 0, *padded))

    def fix(self, lat_deg: float, lon_deg: float, age_s: float = 0.0, **changes) -> int:
        """Send a position fix; return the result in the answer to it."""
        fields = {"frame": 0, "z": math.nan, "param1": self.now_s, "param2": age_s, "param3": 5.0} | changes
        place = {"x": round(lat_deg * 1e7), "y": round(lon_deg * 1e7)}
        return self.answer(
            mavlink.MAVLink_command_int_message(
                1, 1, command=FIX, current=0, autocontinue=0, param4=0, **place, **fields
            )
        )

    def set(self, name: str, value: float) -> None:
        for _ in range(3):
            self.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), float(value), 9))
            if abs(self.next("PARAM_VALUE", lambda said: said.param_id == name).param_value - value) < 1e-4:
                return
        raise AssertionError(f"{name} {value} not taken")

    def get(self, name: str) -> float:
        self.send(mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
        return self.next("PARAM_VALUE", lambda said: said.param_id == name).param_value

    def stream(self) -> None:
        for number, rate_hz in _REPORTS_HZ.items():
            assert self.command(511, number, 1e6 / rate_hz) == mavlink.MAV_RESULT_ACCEPTED

    @property
    def flags(self) -> int:
        return self.last["EKF_STATUS_REPORT"].flags

    @property
    def error_m(self) -> float:
        here, truth = self.last["GLOBAL_POSITION_INT"], self.last["SIM_STATE"]
        return float(distance_m(here.lat / 1e7, here.lon / 1e7, truth.lat_int / 1e7, truth.lon_int / 1e7))

    @property
    def true_place(self) -> tuple[float, float]:
        return self.truths[-1][1:]

    def wait_ready(self) -> None:
        wanted = mavlink.EKF_ATTITUDE | mavlink.EKF_POS_HORIZ_ABS
        self.until(
            lambda: "EKF_STATUS_REPORT" in self.last and self.flags & wanted == wanted, "a position", patience_s=120
        )

    def arm(self, mode: int) -> None:
        self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, mode)
        for _ in range(60):
            if self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == mavlink.MAV_RESULT_ACCEPTED:
                return
            self.wait(1)
        raise AssertionError(f"not armed: {self.texts[-5:]}")

    def wait_height(self, height_m: float) -> None:
        self.until(lambda: self.last["GLOBAL_POSITION_INT"].relative_alt > 1000 * height_m, "height", patience_s=150)

    def close(self) -> None:
        self._port.close()


class _Simulated:
    """The bytes of a simulated flight controller. Each read turns its clock on."""

    def __init__(self, vehicle: str, parameters: dict[str, float]) -> None:
        self.controller = Piloted(vehicle, **parameters)
        self._receiver, self._packer = PacketReader(), mavlink.MAVLink(None, 1, 1)
        self._said, self._now_s = b"", 0.0

    def send(self, data: bytes) -> None:
        for message in self._receiver.feed(data):
            self._say(self.controller.receive(message))

    def recv(self, size: int) -> bytes:
        self._now_s += 0.05
        self._say(self.controller.advance(self._now_s))
        said, self._said = self._said, b""
        return said

    def _say(self, messages) -> None:
        for message in messages:
            self._said += message.pack(self._packer)
            self._packer.seq = (self._packer.seq + 1) % 256

    def close(self) -> None:
        pass


class _Real:
    """A real ArduPilot in its own simulator, over TCP."""

    def __init__(self, kind: str, parameters: dict[str, float], folder: Path) -> None:
        tree = Path(ARDUPILOT)
        own = folder / "own.parm"
        own.write_text("".join(f"{name} {value}\n" for name, value in {**_QUIET, **parameters}.items()))
        home = f"{ORIGIN.lat_deg},{ORIGIN.lon_deg},{ORIGIN.alt_m},90"
        defaults = f"{tree}/Tools/autotest/{_DEFAULTS[kind]},{own}"
        command = [tree / f"build/sitl/bin/ardu{kind}", "--model", _MODELS[kind], "--speedup", _SPEEDUP, "--home", home]
        command += [f"-I{_INSTANCE}", "--sim-address", "127.0.0.1", "--defaults", defaults, "--wipe"]
        with open(folder / "sitl.log", "wb") as log:
            self._process = subprocess.Popen(
                [str(word) for word in command], cwd=folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        for attempt in range(600):
            try:
                self._sock = socket.create_connection(("127.0.0.1", 5760 + 10 * _INSTANCE), 5)
                break
            except OSError:
                if attempt == 599:
                    raise
                time.sleep(0.1)
        self._sock.settimeout(0.2)

    def send(self, data: bytes) -> None:
        self._sock.sendall(data)

    def recv(self, size: int) -> bytes:
        try:
            return self._sock.recv(size)
        except TimeoutError:
            return b""

    def close(self) -> None:
        self._sock.close()
        self._process.terminate()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class _RealPx4:
    """A real PX4 in its own simulator, over UDP, at the altitude of the ground."""

    def __init__(self, parameters: dict[str, float], folder: Path) -> None:
        home = dict(zip(("LAT", "LON", "ALT"), (ORIGIN.lat_deg, ORIGIN.lon_deg, ORIGIN.alt_m), strict=True))
        own = {f"PX4_HOME_{name}": str(value) for name, value in home.items()}
        own |= {f"PX4_PARAM_{name}": str(value) for name, value in parameters.items()}
        own |= {"PX4_SIMULATOR": "sihsim", "PX4_SIM_MODEL": "sihsim_quadx", "HEADLESS": "1"}
        command = [f"{PX4}/bin/px4", "-d", f"{PX4}/etc", "-w", str(folder)]
        streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen(
            command, cwd=folder, env={**os.environ, **own}, start_new_session=True, **streams
        )
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind(("127.0.0.1", 14550))
        self._sock.settimeout(0.2)

    def send(self, data: bytes) -> None:
        with suppress(OSError):
            self._sock.sendto(data, ("127.0.0.1", 18570))

    def recv(self, size: int) -> bytes:
        try:
            return self._sock.recv(size)
        except OSError:
            return b""

    def close(self) -> None:
        self._sock.close()
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


def pilot_of(which: str, vehicle: str, parameters: dict[str, float], folder: Path) -> Pilot:
    """Start a flight controller, "simulated" or "real", and return the pilot at it."""
    if which == "simulated":
        port = _Simulated(vehicle, parameters)
    elif vehicle.startswith("px4"):
        port = _RealPx4(parameters, folder)
    else:
        port = _Real(vehicle.removeprefix("ardu"), parameters, folder)
    pilot = Pilot(port)
    try:
        # Over a link that is told to stream nothing, its clock is seen in SYSTEM_TIME alone.
        pilot.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))
        give_up_s = time.monotonic() + PATIENCE_S
        while "HEARTBEAT" not in pilot.last and time.monotonic() < give_up_s:
            pilot.read()
        number = mavlink.MAVLINK_MSG_ID_SYSTEM_TIME
        pilot.send(mavlink.MAVLink_command_long_message(1, 1, 511, 0, number, 50_000, 0, 0, 0, 0, 0))
        while "SYSTEM_TIME" not in pilot.last and time.monotonic() < give_up_s:
            pilot.read()
        if not vehicle.startswith("px4"):
            pilot.stream()
    except BaseException:
        pilot.close()
        raise
    return pilot
