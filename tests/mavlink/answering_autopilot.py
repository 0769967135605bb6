"""An autopilot that answers questions over UDP, in a thread of its own; it notes what it is told."""

import math
import select
import threading
import time

from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.ports import open_port
from edgevpr.mavlink.wire import PacketReader, mavlink

BEAT_S = 0.05  # twenty times as fast as a real one, so that nothing is waited for


class AnsweringAutopilot:
    """A quadrotor with ArduPilot, which speaks to the UDP port `to`.

    `messages` are those it can be asked for, `parameters` those it has. It `loses` so many of the first questions of
    each kind; `is_mute` answers nothing at all; `says_unknown` answers for a parameter that it has not (else it is
    silent, as older firmware is). It signs with its `key`."""

    def __init__(
        self, to: int, *, parameters=None, messages=(), system_id=1, loses=0, is_mute=False, says_unknown=True,
        key=None, version_1=False, noise=b"",
    ) -> None:  # fmt: skip
        self.heard = []
        self._parameters, self._loses, self._noise = parameters or {}, loses, noise
        self._messages = {message.get_msgId(): message for message in messages}
        self._is_mute, self._says_unknown, self._version_1 = is_mute, says_unknown, version_1
        self._packer = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=1)
        if key:
            self._packer.signing.secret_key, self._packer.signing.sign_outgoing = key, True
            self._packer.signing.timestamp = int((time.time() - 1_420_070_400) * 1e5)
        self._receiver = PacketReader()
        self._port = open_port(parse_link(f"udpout:127.0.0.1:{to}"))
        self._lost = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()
        self._port.close()

    def names(self) -> set[str]:
        """Names of all messages that were heard."""
        return {message.get_type() for message in self.heard}

    def _run(self) -> None:
        beat_s = 0.0
        while not self._stop.is_set():
            if time.monotonic() >= beat_s:
                beat_s = time.monotonic() + BEAT_S
                self._send(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4, 3))
                if self._noise:
                    self._port.write(self._noise)
            is_readable = select.select([self._port], [], [], BEAT_S)[0]
            for message in self._receiver.feed(self._port.read() if is_readable else b""):
                self.heard.append(message)
                if not self._is_mute and not self._is_lost(message):
                    self._answer(message)

    def _is_lost(self, message) -> bool:
        kind = message.get_type(), getattr(message, "param_id", None), getattr(message, "param1", None)
        self._lost[kind] = self._lost.get(kind, 0) + 1
        return self._lost[kind] <= self._loses

    def _answer(self, message) -> None:
        kind = message.get_type()
        if kind == "TIMESYNC" and message.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(time.monotonic_ns(), message.ts1))
        elif kind == "COMMAND_LONG":
            known = self._messages.get(int(message.param1)) if message.command == 512 else None
            self._send(mavlink.MAVLink_command_ack_message(message.command, 0 if known else 2))
            if known:
                self._send(known)
        elif kind == "PARAM_REQUEST_READ":
            self._send_parameter(message.param_id)

    def _send_parameter(self, name: str) -> None:
        if name not in self._parameters:
            if self._says_unknown:
                self._send(mavlink.MAVLink_param_error_message(1, 197, name.encode(), -1, 1))
            return
        value = self._parameters[name]
        kind = mavlink.MAV_PARAM_TYPE_INT32 if isinstance(value, int) else mavlink.MAV_PARAM_TYPE_REAL32
        self._send(mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(self._parameters), 0))

    def _send(self, message) -> None:
        self._port.write(message.pack(self._packer, force_mavlink1=self._version_1))
        self._packer.seq = (self._packer.seq + 1) % 256


def healthy_messages():
    """What an ArduPilot 4.7.0 with GPS, on the ground and ready, can be asked for."""
    packed, eight = 4 << 24 | 7 << 16 | 255, [0] * 8
    return (
        mavlink.MAVLink_autopilot_version_message(0, packed, 0, 0, 0, eight, eight, eight, 0, 0, 0),
        mavlink.MAVLink_ekf_status_report_message(0x33F, 0, 0, 0, 0, 0),
        mavlink.MAVLink_gps_raw_int_message(0, 3, 500_000_000, 140_000_000, 0, 80, 120, 0, 0, 14),
        mavlink.MAVLink_gps_global_origin_message(500_000_000, 140_000_000, 0),
        mavlink.MAVLink_global_position_int_message(0, 500_000_000, 140_000_000, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_attitude_message(0, 0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0),
        mavlink.MAVLink_system_time_message(round(time.time() * 1e6), 0),
    )
