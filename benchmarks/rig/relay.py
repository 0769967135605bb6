"""The wire between edgevpr and the autopilot, listened to: every position that was sent, against the true one."""

import contextlib
import socket
import threading
import time
from pathlib import Path

from truth import Truth

from edgevpr.lab.simulate.generated import to_metres
from edgevpr.mavlink.wire import Message, PacketReader, mavlink

COLUMNS = ("t_s", "kind", "age_s", "east_m", "north_m", "accuracy_m", "true_east_m", "true_north_m")
Sent = tuple[float, float, float, float]  # age in seconds, east and north in metres, accuracy in metres


class Relay:
    """Hands on what edgevpr and the autopilot say to each other over TCP, from the begin of the `with` block to its
    end. `origin_m` is where the autopilot's local frame begins, metres east and north."""

    def __init__(self, truth: Truth, log: Path, autopilot_port: int, origin_m: tuple[float, float]) -> None:
        self._truth, self._autopilot_port, self._origin_m = truth, autopilot_port, origin_m
        self._log = open(log, "w", encoding="utf-8", buffering=1)  # noqa: SIM115 (closed at the end of the block)
        self._log.write(",".join(COLUMNS) + "\n")
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._is_open = True
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> "Relay":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_open = False
        self._thread.join()
        self._listener.close()
        self._log.close()

    def _serve(self) -> None:
        self._listener.settimeout(0.2)
        while self._is_open:
            with contextlib.suppress(OSError):  # nobody comes, one of the two is not there, or has gone
                near, _ = self._listener.accept()
                with near, socket.create_connection(("127.0.0.1", self._autopilot_port), 1) as far:
                    for end in (near, far):
                        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    back = threading.Thread(target=self._hand_on, args=(far, near, None), daemon=True)
                    back.start()
                    self._hand_on(near, far, PacketReader())
                    back.join()

    def _hand_on(self, source: socket.socket, sink: socket.socket, receiver: PacketReader | None) -> None:
        """Hand on bytes until one of the two has gone, and let the other one know."""
        source.settimeout(0.2)
        try:
            while self._is_open:
                try:
                    data = source.recv(65536)
                except TimeoutError:
                    continue
                if not data:
                    break
                sink.sendall(data)
                for message in receiver.feed(data) if receiver else ():
                    self._note(message, time.monotonic())
        except OSError:
            pass
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def _note(self, message: Message, now_s: float) -> None:
        sent = _sent(message, self._origin_m)
        if sent is None:
            return
        true = self._truth.at(now_s - sent[0])
        if true is not None:
            figures = (*sent, true.east_m, true.north_m)
            self._log.write(f"{now_s:.4f},{message.get_type()}," + ",".join(f"{each:.3f}" for each in figures) + "\n")


class DatagramRelay(Relay):
    """The same between a PX4, which sends to a port of its choice, and edgevpr, which listens at `port`."""

    def __init__(self, truth: Truth, log: Path, ports: tuple[int, int], origin_m: tuple[float, float]) -> None:
        self._autopilot, self._heard = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._autopilot.bind(("127.0.0.1", ports[0]))
        self._autopilot.connect(("127.0.0.1", ports[1]))
        super().__init__(truth, log, ports[1], origin_m)
        self._heard.connect(("127.0.0.1", self.port))

    def _serve(self) -> None:
        back = threading.Thread(target=self._carry, args=(self._autopilot, self._heard, None))
        back.start()
        self._carry(self._heard, self._autopilot, PacketReader())
        back.join()
        for each in (self._autopilot, self._heard):
            each.close()

    def _carry(self, source: socket.socket, sink: socket.socket, receiver: PacketReader | None) -> None:
        source.settimeout(0.2)
        while self._is_open:
            with contextlib.suppress(OSError):  # nothing comes, or the other one does not listen yet
                data = source.recv(65536)
                sink.send(data)
                for message in receiver.feed(data) if receiver else ():
                    self._note(message, time.monotonic())


def _sent(message: Message, origin_m: tuple[float, float]) -> Sent | None:
    """Return what a message says of the position: its age, the position, and the 1-sigma accuracy of an axis; None
    where it says nothing."""
    kind = message.get_type()
    if kind == "COMMAND_INT" and message.command == mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE:
        return message.param2, *to_metres(message.x / 1e7, message.y / 1e7), message.param3
    if kind == "GLOBAL_POSITION_SENSOR":
        return 0.0, *to_metres(message.lat / 1e7, message.lon / 1e7), message.eph
    if kind == "GPS_INPUT" and message.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
        return 0.0, *to_metres(message.lat / 1e7, message.lon / 1e7), message.horiz_accuracy
    if kind == "ODOMETRY":
        of_axes = [message.pose_covariance[each] for each in (0, 6)]
        accuracy_m = max(of_axes) ** 0.5
        if message.frame_id == mavlink.MAV_FRAME_LOCAL_FRD:  # as ArduPilot reads it (see messages.odometry)
            accuracy_m = sum(each**2 for each in of_axes) ** (1 / 3)
        return 0.0, origin_m[0] + message.y, origin_m[1] + message.x, accuracy_m
    return None
