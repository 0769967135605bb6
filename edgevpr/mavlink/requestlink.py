"""Requests to an autopilot before the flight, for `edgevpr check` and `doctor`, which do not change its settings."""

import select
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass

from edgevpr.core.errors import LinkError
from edgevpr.mavlink import messages
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.channel import VehicleKind, classify_vehicle
from edgevpr.mavlink.channelselector import MAX_PARALLEL_REQUESTS
from edgevpr.mavlink.clock import HEARTBEAT_TIMEOUT_S
from edgevpr.mavlink.parameters import ALTERNATIVES
from edgevpr.mavlink.ports import open_port
from edgevpr.mavlink.signing import NOT_SIGNING, Signing
from edgevpr.mavlink.wire import Message, PacketReader, mavlink, read_parameter_value

HEARTBEAT_INTERVAL_S = 1.0
MAX_TRIES = 3
ANSWER_TIMEOUT_S = 1.0
LISTEN_S = 4.0  # time to detect other autopilots, corrupt bytes and signatures

_STREAM_TIMEOUT_S = 1.2
_REFUSALS = (mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_UNSUPPORTED, mavlink.MAV_RESULT_FAILED)
_FIRMWARES = {mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot", mavlink.MAV_AUTOPILOT_PX4: "px4"}
_RELEASES = {0: "-dev", 64: "-alpha", 128: "-beta", 192: "-rc", 255: ""}  # FIRMWARE_VERSION_TYPE


class RequestLink(AbstractContextManager["RequestLink"]):
    """A link to one autopilot whose methods wait for each answer. It sends a heartbeat once a second, because some
    autopilot ports only answer a sender of heartbeats. As a context manager it raises LinkError if the link is lost.

    - `system_id`: system id of the autopilot; None until its first heartbeat, unless configured.
    - `received`: number of messages from the autopilot, by name; `signed`: number of signed messages among them.
    - `sends_mavlink1`: its last message was MAVLink 1; `round_trips_s`: seconds from each request to its answer.
    - `other_systems`: system ids of other autopilots on the link; `reader` counts bytes outside any message."""

    def __init__(
        self, address: LinkAddress, own_id: int = 197, system_id: int | None = None, signing: Signing = NOT_SIGNING
    ) -> None:
        """Open the link. `own_id`: our component id. `system_id`: of the autopilot (None: any). Raises LinkError."""
        self.system_id = system_id
        self.received: Counter[str] = Counter()
        self.signed = 0
        self.other_systems: set[int] = set()
        self.sends_mavlink1 = False
        self.round_trips_s: list[float] = []
        self.signing, self.reader = signing, PacketReader(signing.admits)
        self._address = address
        self._packer = mavlink.MAVLink(None, srcSystem=system_id or 1, srcComponent=own_id)
        self._unread: deque[Message] = deque()  # messages from the autopilot, not yet returned to the caller
        self._heartbeat_due_s = 0.0
        try:
            self._port = open_port(address)
        except OSError as error:
            cause = error.strerror or error
            advice = "connect the device or start the other end, or correct the link address"
            raise LinkError(f"{address} cannot be opened ({cause}): {advice}.") from error

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        self._port.close()
        if isinstance(error, OSError):
            raise LinkError(f"{self._address}: link lost ({error.strerror or error}): check the cable.") from error

    def wait_for_heartbeat(self, wait_s: float = HEARTBEAT_TIMEOUT_S) -> Message | None:
        """Wait for the heartbeat of an autopilot (None: none arrived). Other autopilots are ignored from then on."""
        return self._wait_for(wait_s, lambda message: bool(message.get_type() == "HEARTBEAT"))

    def listen(self, wait_s: float) -> None:
        """Receive and count messages for `wait_s` seconds, without requesting any."""
        self._wait_for(wait_s, lambda message: False)

    def request_message(self, message_id: int) -> Message | None:
        """Request one message (MAV_CMD_REQUEST_MESSAGE) and return it; None if it was refused or not answered."""
        name = mavlink.mavlink_map[message_id].msgname
        for _ in range(MAX_TRIES):
            sent_s = time.monotonic()
            self._send(messages.make_message_request(self.system_id or 0, message_id))
            answer = self._wait_for(ANSWER_TIMEOUT_S, lambda reply: reply.get_type() == name or _is_refusal(reply))
            if answer is None:
                continue
            self.round_trips_s.append(time.monotonic() - sent_s)
            if answer.get_type() != name and answer.result == mavlink.MAV_RESULT_DENIED:
                # PX4 refuses to send a message that has not changed since it was last streamed: wait for the stream.
                answer = self._wait_for(_STREAM_TIMEOUT_S, lambda message: message.get_type() == name)
            return answer if answer and answer.get_type() == name else None
        return None

    def request_parameters(self, names: Iterable[str], bytewise: bool) -> dict[str, float | int]:
        """Request parameters by name (PARAM_REQUEST_READ) and return their values by name, without those that the
        autopilot lacks or whose value is not finite. For `bytewise` see `read_parameter_value`."""
        values: dict[str, float | int] = {}
        missing = list(dict.fromkeys(names))
        for _ in range(MAX_TRIES):
            for start in range(0, len(missing), MAX_PARALLEL_REQUESTS):
                batch = missing[start : start + MAX_PARALLEL_REQUESTS]
                for name in batch:
                    self._send(messages.make_parameter_request(self.system_id or 0, name))
                pending = set(batch)
                while pending and (answer := self._wait_for(ANSWER_TIMEOUT_S, _match_parameters(pending))):
                    pending.remove(answer.param_id)
                    value = read_parameter_value(answer, bytewise) if answer.get_type() == "PARAM_VALUE" else None
                    if value is not None:
                        values[answer.param_id] = value
            missing = [name for name in missing if name not in values]
        return values

    def _wait_for(self, wait_s: float, is_wanted: Callable[[Message], bool]) -> Message | None:
        """Return the first wanted message among the unread ones and those that arrive within `wait_s` seconds."""
        deadline_s = time.monotonic() + wait_s
        while True:
            while self._unread:
                if is_wanted(message := self._unread.popleft()):
                    return message
            now_s = time.monotonic()
            if now_s >= deadline_s:
                return None
            self._receive(now_s, min(deadline_s - now_s, 0.25))

    def _receive(self, now_s: float, wait_s: float) -> None:
        """Send a heartbeat if one is due, then receive for up to `wait_s` seconds."""
        if self._port.connected and now_s >= self._heartbeat_due_s:
            self._heartbeat_due_s = now_s + HEARTBEAT_INTERVAL_S
            # Generic type, not onboard controller: otherwise PX4 would report a lost companion after this exchange.
            self._send(messages.make_heartbeat(messages.Health.BOOT, mavlink.MAV_TYPE_GENERIC))
        readable, _, _ = select.select([self._port], [], [], wait_s)
        # Reading an idle serial port would look like a disconnect. A refused datagram keeps a UDP port readable.
        data = self._port.read() if readable else b""
        if readable and not data:
            time.sleep(0.01)
        self._unread.extend(filter(self._admit, self.reader.feed(data, self._port.sender)))

    def _admit(self, message: Message) -> bool:
        is_heartbeat = message.get_type() == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID
        if message.get_srcComponent() != messages.AUTOPILOT or message.get_srcSystem() == 0:
            return False
        if is_heartbeat and self.system_id is None:
            self.system_id = self._packer.srcSystem = message.get_srcSystem()
        if message.get_srcSystem() != self.system_id:
            self.other_systems |= {message.get_srcSystem()} if is_heartbeat else set()
            return False
        if is_heartbeat:
            self._port.adopt_sender_as_peer()
        elif not self.received:
            return False
        self.received[message.get_type()] += 1
        self.signed += bool(message.get_header().incompat_flags & mavlink.MAVLINK_IFLAG_SIGNED)
        self.sends_mavlink1 = message.get_msgbuf()[0] == mavlink.PROTOCOL_MARKER_V1
        return True

    def _send(self, message: Message) -> None:
        """Send a message. Bytes that a full port does not accept are lost, so requests are repeated."""
        self.signing.stamp(self._packer)
        self._port.write(message.pack(self._packer))
        self._packer.seq = (self._packer.seq + 1) % 256


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotReading:
    """The values that an autopilot reports about itself; None or empty if it did not answer."""

    system_id: int
    firmware: str  # "ardupilot", "px4" or "other"
    vehicle: str  # the value of a `VehicleKind`
    is_armed: bool
    version: tuple[int, int, int] | None
    version_text: str | None
    parameters: dict[str, float | int]
    received: tuple[str, ...]  # names of all messages received
    gps_fix: tuple[int | None, int | None]  # GPS_FIX_TYPE of both receivers
    filter_flags: int | None  # of EKF_STATUS_REPORT or ESTIMATOR_STATUS
    origin: tuple[float, float] | None  # of its local frame: latitude, longitude in degrees
    signs: bool  # its messages are signed
    signs_requests: bool  # our messages to it are signed
    answers: bool  # it has answered a request
    sends_mavlink1: bool  # it sends MAVLink 1
    other_systems: tuple[int, ...]  # system ids of other autopilots on the link
    bad_bytes: int  # bytes outside any valid message
    round_trip_s: float | None  # median round trip of requests
    clock_ahead_s: float | None  # its UTC minus that of this machine

    @property
    def kind(self) -> VehicleKind:
        return VehicleKind(self.vehicle)


def read_autopilot(link: RequestLink, names_by_firmware: Mapping[str, Iterable[str]]) -> AutopilotReading | None:
    """Read, within ten seconds, what an autopilot reports about itself; return None if no heartbeat arrives.
    `names_by_firmware`: names of the parameters to read, by firmware. Their names in other releases are also tried."""
    heartbeat = link.wait_for_heartbeat()
    if heartbeat is None:
        return None
    firmware = _FIRMWARES.get(heartbeat.autopilot, "other")
    link.listen(LISTEN_S)
    version_message = link.request_message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    answers = bool(version_message or link.received["COMMAND_ACK"])
    is_px4 = firmware == "px4"
    message_ids = (
        mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS if is_px4 else mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
        mavlink.MAVLINK_MSG_ID_GPS2_RAW,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        mavlink.MAVLINK_MSG_ID_ATTITUDE,
    )
    names = tuple(names_by_firmware.get(firmware, ())) if answers else ()
    # Without answers, each request would take three seconds. The last two messages are only counted.
    filter_state, gps_1, gps_2, origin, clock, *_ = (link.request_message(n) if answers else None for n in message_ids)
    parameters = link.request_parameters(names, is_px4)
    other_names = (ALTERNATIVES.get(name) for name in names if name not in parameters)
    parameters |= link.request_parameters(filter(None, other_names), is_px4)
    packed = version_message.flight_sw_version if version_message else 0
    version = packed >> 24, packed >> 16 & 255, packed >> 8 & 255
    return AutopilotReading(
        system_id=heartbeat.get_srcSystem(),
        firmware=firmware,
        vehicle=classify_vehicle(heartbeat.type).value,
        is_armed=bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED),
        version=version if version_message else None,
        version_text=".".join(map(str, version)) + _RELEASES.get(packed & 255, "") if version_message else None,
        parameters=parameters,
        received=tuple(sorted(link.received)),
        gps_fix=(gps_1 and gps_1.fix_type, gps_2 and gps_2.fix_type),
        filter_flags=filter_state and filter_state.flags,
        origin=(origin.latitude / 1e7, origin.longitude / 1e7) if origin else None,
        signs=link.signed > 0,
        signs_requests=link.signing is not NOT_SIGNING,
        answers=answers,
        sends_mavlink1=link.sends_mavlink1,
        other_systems=tuple(sorted(link.other_systems)),
        bad_bytes=link.reader.bad_bytes,
        round_trip_s=statistics.median(link.round_trips_s) if link.round_trips_s else None,
        clock_ahead_s=clock.time_unix_usec / 1e6 - time.time() if clock and clock.time_unix_usec else None,
    )


def _is_refusal(message: Message) -> bool:
    is_answer = message.get_type() == "COMMAND_ACK" and message.command == mavlink.MAV_CMD_REQUEST_MESSAGE
    return is_answer and message.result in _REFUSALS


def _match_parameters(names: set[str]) -> Callable[[Message], bool]:
    kinds = ("PARAM_VALUE", "PARAM_ERROR")  # PARAM_ERROR: the parameter is unknown
    return lambda message: message.get_type() in kinds and message.param_id in names
