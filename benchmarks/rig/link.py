"""The MAVLink connection of the rig's own ground station to the autopilot."""

import contextlib
import math
import socket
import struct
import threading
import time
from collections.abc import Callable

from edgevpr.mavlink.wire import Message, PacketReader, mavlink, read_parameter_value

GCS_ADDRESS = (255, 190)  # system, component
AUTOPILOT_ADDRESS = (1, 1)
# SIM_STATE is the truth. A plane, whose main loop runs at 50 Hz, sends it no faster.
STREAMS_HZ = {
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 2,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10,
    mavlink.MAVLINK_MSG_ID_SIM_STATE: 40,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 5,
}
Listener = Callable[[Message, float], None]
Condition = Callable[[Message], bool]


class Link:
    """A connection that keeps the newest message of each name in `last`, and its time of receipt in `received_s`, and
    passes every message to the listeners with its time. Names have the command, as in "COMMAND_ACK 400", or a component
    other than the autopilot, as in "HEARTBEAT of 197". `bytewise`: integer parameters are sent as bytes, as in PX4."""

    def __init__(self, connected: socket.socket, listeners: list[Listener], bytewise: bool = False) -> None:
        self.last: dict[str, Message] = {}
        self.received_s: dict[str, float] = {}
        self._listeners = listeners
        self._socket, self._bytewise = connected, bytewise
        self._mav = mavlink.MAVLink(self, *GCS_ADDRESS)
        self._is_open, self._lock = True, threading.Lock()
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._receive, self._send_heartbeats)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        self._is_open = False
        for thread in self._threads:
            thread.join()
        self._socket.close()

    def write(self, data: bytes) -> None:
        """Send bytes, as a file for pymavlink; does nothing if the autopilot has disconnected."""
        with contextlib.suppress(OSError):
            self._socket.sendall(data)

    def send(self, message: Message) -> None:
        with self._lock:
            self._mav.send(message)

    def wait_for(
        self, name: str, condition: Condition, timeout_s: float, since_s: float | None = None
    ) -> Message | None:
        """Return the first message of a name, received after `since_s` (None: now), that fulfils a condition; None if
        there is none within `timeout_s`."""
        since_s = time.monotonic() if since_s is None else since_s
        while time.monotonic() - since_s < timeout_s:
            if self.received_s.get(name, 0.0) >= since_s and condition(self.last[name]):
                return self.last[name]
            time.sleep(0.01)
        return None

    def command(self, number: int, *values: float) -> int | None:
        """Send a COMMAND_LONG; return the result of its COMMAND_ACK, None if there is none in time."""
        parameters = [*values, *[0.0] * (7 - len(values))]
        sent_s = time.monotonic()
        self.send(mavlink.MAVLink_command_long_message(*AUTOPILOT_ADDRESS, number, 0, *parameters))
        answer = self.wait_for(f"COMMAND_ACK {number}", lambda _: True, 4.0, sent_s)
        return answer and answer.result

    def send_parameter(self, name: str, value: float) -> None:
        """Set a parameter without waiting: the autopilot does not answer if the value has hardly changed."""
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        if self._bytewise and isinstance(value, int):
            kind, value = mavlink.MAV_PARAM_TYPE_INT32, struct.unpack("<f", struct.pack("<i", value))[0]
        self.send(mavlink.MAVLink_param_set_message(*AUTOPILOT_ADDRESS, name.encode(), float(value), kind))

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter. Raises RuntimeError if the autopilot does not accept it."""

        def is_accepted(message: Message) -> bool:
            current = read_parameter_value(message, self._bytewise) if message.param_id == name else None
            return current is not None and math.isclose(current, value, rel_tol=1e-5, abs_tol=1e-6)  # 32-bit floats

        for _ in range(4):
            self.send_parameter(name, value)
            if self.wait_for("PARAM_VALUE", is_accepted, 1.5):
                return
        raise RuntimeError(f"the autopilot does not accept {name} {value}")

    def upload_mission(self, items: list[Message]) -> None:
        """Upload a mission. Raises RuntimeError if the autopilot does not accept it."""
        began_s = time.monotonic()
        self.send(mavlink.MAVLink_mission_count_message(*AUTOPILOT_ADDRESS, len(items)))
        answered_s: dict[str, float] = {}
        while time.monotonic() - began_s < 20:
            for name in ("MISSION_REQUEST_INT", "MISSION_REQUEST"):
                request_s = self.received_s.get(name, 0.0)
                if request_s > answered_s.get(name, began_s):
                    answered_s[name] = request_s
                    self.send(items[self.last[name].seq])
            if self.received_s.get("MISSION_ACK", 0.0) >= began_s:
                if self.last["MISSION_ACK"].type == mavlink.MAV_MISSION_ACCEPTED:
                    return
                break
            time.sleep(0.005)
        raise RuntimeError("the autopilot does not accept the mission")

    def _receive(self) -> None:
        receiver = PacketReader()
        self._socket.settimeout(0.2)
        while self._is_open:
            try:
                data = self._socket.recv(65536)
            except (TimeoutError, ConnectionRefusedError):  # refused: a datagram, before the autopilot has started
                continue
            except OSError:
                data = b""
            if not data:
                return  # the autopilot has disconnected; callers time out
            now_s = time.monotonic()
            for message in receiver.feed(data):
                name, sender = message.get_type(), message.get_srcComponent()
                if sender != AUTOPILOT_ADDRESS[1]:
                    name = f"{name} of {sender}"
                elif name == "COMMAND_ACK":
                    name = f"{name} {message.command}"
                self.last[name] = message
                self.received_s[name] = now_s  # set last, so that readers of the time find the message
                for listener in self._listeners:
                    listener(message, now_s)

    def _send_heartbeats(self) -> None:
        kind, autopilot = mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID
        while self._is_open:
            self.send(mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, mavlink.MAV_STATE_ACTIVE, 3))
            time.sleep(0.5)


def connect(port: int) -> socket.socket:
    """Return a TCP connection to a port of this machine. Raises RuntimeError if none is accepted within 30 s."""
    give_up_s = time.monotonic() + 30
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port), 1)
        except OSError:
            if time.monotonic() > give_up_s:
                raise RuntimeError(f"no simulator answers at port {port}") from None
            time.sleep(0.1)
