"""A relay between edgevpr and the autopilot that logs every sent position together with the true one."""

import contextlib
import math
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

from truth import Truth

from edgevpr.lab.simulate.generated import to_metres
from edgevpr.mavlink.wire import Message, PacketReader, mavlink

COLUMNS = ("t_s", "kind", "age_s", "east_m", "north_m", "accuracy_m", "true_east_m", "true_north_m")
_POLL_S = 0.2
_SLOW_BUFFER_BYTES = 4096  # of a slow link: what does not fit is lost, not delayed
SentPosition = tuple[float, float, float, float]  # age in seconds, east and north in metres, accuracy in metres


class Relay:
    """A relay, within the `with` block, between edgevpr, which connects to `uri`, and the autopilot at a port. As on a
    serial line, edgevpr receives nothing while the autopilot has no power. `drops` decides which messages of edgevpr
    are lost, `inject` sends messages of another program, and `saturate` makes the link slow. `origin_m` is the origin
    of the autopilot's local frame, metres east and north."""

    def __init__(self, truth: Truth, log: Path, autopilot_port: int, origin_m: tuple[float, float]) -> None:
        self._truth, self._autopilot_port, self._origin_m = truth, autopilot_port, origin_m
        self._log = open(log, "w", encoding="utf-8", buffering=1)  # noqa: SIM115 (closed at the end of the block)
        self._log.write(",".join(COLUMNS) + "\n")
        self.drops: Callable[[Message], bool] = lambda message: False
        self._reader, self._bytes_per_s = PacketReader(), math.inf
        self._edgevpr_socket: socket.socket | None = None
        self._autopilot_socket: socket.socket | None = None
        self._is_open = True
        self.uri = self._listen()
        self._threads = [threading.Thread(target=work) for work in (self._serve_edgevpr, self._serve_autopilot)]

    def __enter__(self) -> "Relay":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_open = False
        for thread in self._threads:
            thread.join()
        self._server.close()
        self._log.close()

    def inject(self, data: bytes, to_edgevpr: bool = False) -> None:
        """Send data to the autopilot and, if `to_edgevpr`, to edgevpr, as a router sends messages without target."""
        self._send(self._autopilot_socket, data)
        if to_edgevpr:
            self._send(self._edgevpr_socket, data)

    def saturate(self, bytes_per_s: float) -> None:
        """From now on, limit the rate in each direction to `bytes_per_s` and lose the rest."""
        self._bytes_per_s = bytes_per_s
        for connection in filter(None, (self._edgevpr_socket, self._autopilot_socket)):
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SLOW_BUFFER_BYTES)

    def _listen(self) -> str:
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(_POLL_S)
        return f"tcp:127.0.0.1:{self._server.getsockname()[1]}"

    def _serve_edgevpr(self) -> None:
        while self._is_open:
            with contextlib.suppress(OSError):  # edgevpr has not connected
                self._edgevpr_socket, _ = self._server.accept()
                with self._edgevpr_socket:
                    self._forward_data(self._edgevpr_socket, self._forward_to_autopilot)

    def _serve_autopilot(self) -> None:
        while self._is_open:
            with contextlib.suppress(OSError):  # the autopilot has no power
                self._autopilot_socket = socket.create_connection(("127.0.0.1", self._autopilot_port), 1)
                with self._autopilot_socket:
                    self._forward_data(self._autopilot_socket, lambda data: self._send(self._edgevpr_socket, data))
            time.sleep(_POLL_S)

    def _forward_data(self, source: socket.socket, deliver: Callable[[bytes], object]) -> None:
        """Pass data from a socket to `deliver`, until the socket is closed."""
        source.settimeout(_POLL_S)
        if source.type == socket.SOCK_STREAM:
            source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while self._is_open:
            try:
                data = source.recv(65536)
            except (TimeoutError, ConnectionRefusedError):  # refused: a datagram, before the receiver has started
                continue
            if not data:
                return
            time.sleep(len(data) / self._bytes_per_s)
            deliver(data)

    def _forward_to_autopilot(self, data: bytes) -> None:
        for message in self._reader.feed(data):
            if not self.drops(message):
                self.inject(bytes(message.get_msgbuf()))
            self._log_position(message, time.monotonic())

    def _send(self, sink: socket.socket | None, data: bytes) -> None:
        with contextlib.suppress(OSError, AttributeError):  # the receiver is not connected
            sink.sendall(data)

    def _log_position(self, message: Message, now_s: float) -> None:
        sent = _read_position(message, self._origin_m)
        if sent is None:
            return
        true = self._truth.compute_pose(now_s - sent[0])
        if true is not None:
            figures = (*sent, true.east_m, true.north_m)
            self._log.write(f"{now_s:.4f},{message.get_type()}," + ",".join(f"{value:.3f}" for value in figures) + "\n")


class DatagramRelay(Relay):
    """A relay for PX4, which sends to the first of `ports` and listens at the second; edgevpr listens at `uri`."""

    def __init__(self, truth: Truth, log: Path, ports: tuple[int, int], origin_m: tuple[float, float]) -> None:
        super().__init__(truth, log, ports[1], origin_m)
        self._autopilot_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._autopilot_socket.bind(("127.0.0.1", ports[0]))
        self._autopilot_socket.connect(("127.0.0.1", ports[1]))

    def _listen(self) -> str:
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port = probe.getsockname()[1]
        self._edgevpr_socket = self._server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._edgevpr_socket.connect(("127.0.0.1", port))
        return f"udpin:127.0.0.1:{port}"

    def _serve_edgevpr(self) -> None:
        self._forward_data(self._edgevpr_socket, self._forward_to_autopilot)

    def _serve_autopilot(self) -> None:
        with self._autopilot_socket:
            self._forward_data(self._autopilot_socket, lambda data: self._send(self._edgevpr_socket, data))


def _read_position(message: Message, origin_m: tuple[float, float]) -> SentPosition | None:
    """Return the position in a message: age in seconds, east and north in metres, and the 1-sigma accuracy per axis;
    None if the message has no position."""
    kind = message.get_type()
    if kind == "COMMAND_INT" and message.command == mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE:
        return message.param2, *to_metres(message.x / 1e7, message.y / 1e7), message.param3
    if kind == "GLOBAL_POSITION_SENSOR":
        return 0.0, *to_metres(message.lat / 1e7, message.lon / 1e7), message.eph
    if kind == "GPS_INPUT" and message.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
        return 0.0, *to_metres(message.lat / 1e7, message.lon / 1e7), message.horiz_accuracy
    if kind == "ODOMETRY":
        variances_m2 = [message.pose_covariance[number] for number in (0, 6)]
        accuracy_m = max(variances_m2) ** 0.5
        if message.frame_id == mavlink.MAV_FRAME_LOCAL_FRD:  # as ArduPilot computes it (see messages.odometry)
            accuracy_m = sum(number**2 for number in variances_m2) ** (1 / 3)
        return 0.0, origin_m[0] + message.y, origin_m[1] + message.x, accuracy_m
    return None
