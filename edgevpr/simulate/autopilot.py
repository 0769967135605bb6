"""A simulated flight controller, as strict as the real thing: the other end of a link, for tests and demonstrations."""

import json
import logging
import math
import select
import signal
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from edgevpr.errors import LinkError, UsageError
from edgevpr.frames.positions import read_positions
from edgevpr.geodesy import offset_m
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.messages import AUTOPILOT, POSITION_FIX
from edgevpr.mavlink.transport import Transport, open_transport
from edgevpr.mavlink.wire import Message, Receiver, mavlink

HEARTBEAT_S = 1.0
POSITION_S = 0.2
TURN_S = 0.05
_FASTEST_M_S = 327.0  # that the message can say

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedFix:
    """An accepted position fix as it arrived; `t_sent_s` and `processing_s` are the sender's."""

    lat_deg: float
    lon_deg: float
    accuracy_m: float
    t_sent_s: float
    processing_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """Path of the simulated vehicle: seconds from its start on, degrees, metres above sea level, each (N,) float64;
    heading, roll, pitch and height above the ground are NaN where unknown (None: everywhere)."""

    t_s: np.ndarray
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    alt_m: np.ndarray
    heading_deg: np.ndarray
    roll_deg: np.ndarray | None = None
    pitch_deg: np.ndarray | None = None
    height_m: np.ndarray | None = None


def read_track(csv_path: str | Path) -> Track:
    """Read the rows of a positions.csv that have a position and a time, in the order of time. Raises UsageError where
    there are none."""
    tags = [tag for tag in read_positions(csv_path).values() if tag.position and tag.t_utc_s is not None]
    if not tags:
        raise UsageError(f"{csv_path} has no row with lat, lon and time: a track needs them.")
    tags.sort(key=lambda tag: tag.t_utc_s)
    start_s = tags[0].t_utc_s
    columns = {
        "t_s": [tag.t_utc_s - start_s for tag in tags],
        "lat_deg": [tag.position.lat_deg for tag in tags],
        "lon_deg": [tag.position.lon_deg for tag in tags],
        "alt_m": [tag.position.alt_m or 0.0 for tag in tags],
        **{name: [getattr(tag, name) for tag in tags] for name in ("heading_deg", "roll_deg", "pitch_deg", "height_m")},
    }
    return Track(**{name: np.array(column, float) for name, column in columns.items()})


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotSummary:
    """Everything that the simulated flight controller received. Senders are written "system/component"."""

    messages: dict[str, int]
    messages_by_sender: dict[str, dict[str, int]]
    companion: str | None  # the last onboard computer heard
    fixes_accepted: int
    fixes_denied: int
    fixes: tuple[ReceivedFix, ...]
    lost_packets: int
    bad_bytes: int

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    def __str__(self) -> str:
        counts = ", ".join(f"{name} {count}" for name, count in sorted(self.messages.items())) or "none"
        return (
            f"companion: {self.companion or 'not heard'}\n"
            f"messages:  {counts}\n"
            f"fixes:     {self.fixes_accepted} accepted, {self.fixes_denied} denied\n"
            f"line:      {self.lost_packets} packets lost, {self.bad_bytes} bad bytes"
        )


def run_autopilot(
    link_url: str,
    duration_s: float | None = None,
    stop: threading.Event | None = None,
    system_id: int = 1,
    track: Track | None = None,
) -> AutopilotSummary:
    """Act as an ArduPilot copter at `link_url` until the time is up, `stop` is set, a signal comes or the line is cut.

    With a `track` it flies along the track from the moment a companion is first heard, reports its position and
    attitude five times a second, and stays where the track ends. Raises LinkError where the link cannot be opened.
    """
    stop = stop or threading.Event()
    address = parse_link(link_url)
    try:
        transport = open_transport(address)
    except OSError as error:
        raise LinkError(f"{address}: it cannot be opened ({error.strerror or error}): is the other end up?") from error
    autopilot = _Autopilot(transport, system_id, track)
    with _set_by_signals(stop):
        try:
            autopilot.run(lambda t_s: stop.is_set() or (duration_s is not None and t_s >= duration_s))
        except OSError as error:
            log.warning("%s was lost (%s)", address, error)
        finally:
            transport.close()
    return autopilot.summary()


def judge(command: Message) -> int:
    """Return the MAV_RESULT for a COMMAND_INT, by the rules of ArduPilot 4.7 for 43003."""
    if command.command != POSITION_FIX:
        return mavlink.MAV_RESULT_UNSUPPORTED
    global_frame = command.frame in (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)
    on_earth = abs(command.x) <= 90e7 and abs(command.y) <= 180e7
    if global_frame and on_earth and math.isnan(command.z) and 0 < command.param3 < math.inf:
        return mavlink.MAV_RESULT_ACCEPTED
    return mavlink.MAV_RESULT_DENIED


class _Autopilot:
    def __init__(self, transport: Transport, system_id: int, track: Track | None) -> None:
        self._transport = transport
        self._track = track
        self._start_s: float | None = None  # of the flight along the track
        self._system_id = system_id
        self._packer = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=AUTOPILOT)
        self._receiver = Receiver()
        self._by_sender: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self._companion: str | None = None
        self._next_seq: dict[str, int] = {}
        self._lost_packets = 0
        self._fixes: list[ReceivedFix] = []
        self._fixes_denied = 0

    def run(self, ended: Callable[[float], bool]) -> None:
        start_s = heartbeat_due_s = position_due_s = time.monotonic()
        while not ended(time.monotonic() - start_s):
            readable, _, _ = select.select([self._transport], [], [], TURN_S)
            if readable:
                for message in self._receiver.feed(self._transport.read()):
                    self._take(message)
            if self._transport.connected and time.monotonic() >= heartbeat_due_s:
                heartbeat_due_s = time.monotonic() + HEARTBEAT_S
                self._send(_copter_heartbeat())
            if self._track and self._start_s is not None and time.monotonic() >= position_due_s:
                position_due_s = time.monotonic() + POSITION_S
                t_s = time.monotonic() - self._start_s
                position = _position(self._track, t_s)
                self._send(_gps(position))
                self._send(position)
                if attitude := _attitude(self._track, t_s):
                    self._send(attitude)

    def summary(self) -> AutopilotSummary:
        return AutopilotSummary(
            messages=dict(self._receiver.received),
            messages_by_sender={sender: dict(counts) for sender, counts in self._by_sender.items()},
            companion=self._companion,
            fixes_accepted=len(self._fixes),
            fixes_denied=self._fixes_denied,
            fixes=tuple(self._fixes),
            lost_packets=self._lost_packets,
            bad_bytes=self._receiver.bad_bytes,
        )

    def _take(self, message: Message) -> None:
        sender = f"{message.get_srcSystem()}/{message.get_srcComponent()}"
        self._by_sender[sender][message.get_type()] += 1
        self._lost_packets += (message.get_seq() - self._next_seq.get(sender, message.get_seq())) % 256
        self._next_seq[sender] = (message.get_seq() + 1) % 256
        if message.get_type() == "HEARTBEAT" and message.type == mavlink.MAV_TYPE_ONBOARD_CONTROLLER:
            self._companion = sender
            self._start_s = self._start_s or time.monotonic()
            self._transport.answer_sender()
        elif message.get_type() == "COMMAND_INT" and self._is_for_me(message):
            self._obey(message)

    def _is_for_me(self, command: Message) -> bool:
        return command.target_system in (0, self._system_id) and command.target_component in (0, AUTOPILOT)

    def _obey(self, command: Message) -> None:
        result = judge(command)
        if result == mavlink.MAV_RESULT_ACCEPTED:
            self._fixes.append(
                ReceivedFix(
                    lat_deg=command.x / 1e7,
                    lon_deg=command.y / 1e7,
                    accuracy_m=command.param3,
                    t_sent_s=command.param1,
                    processing_s=command.param2,
                )
            )
        elif command.command == POSITION_FIX:
            self._fixes_denied += 1
        self._send(
            mavlink.MAVLink_command_ack_message(
                command=command.command,
                result=result,
                target_system=command.get_srcSystem(),
                target_component=command.get_srcComponent(),
            )
        )

    def _send(self, message: Message) -> None:
        self._transport.write(message.pack(self._packer))
        self._packer.seq = (self._packer.seq + 1) % 256


def _copter_heartbeat() -> Message:
    return mavlink.MAVLink_heartbeat_message(
        type=mavlink.MAV_TYPE_QUADROTOR,
        autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode=mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
        custom_mode=0,
        system_status=mavlink.MAV_STATE_ACTIVE,
        mavlink_version=3,
    )


def _position(track: Track, t_s: float) -> Message:
    lat_deg, lon_deg, alt_m = (np.interp(t_s, track.t_s, each) for each in (track.lat_deg, track.lon_deg, track.alt_m))
    heading_deg, height_m = _last(track, track.heading_deg, t_s), _last(track, track.height_m, t_s)
    east_m_s, north_m_s = _velocity_m_s(track, t_s)
    return mavlink.MAVLink_global_position_int_message(
        time_boot_ms=round(t_s * 1000),
        lat=round(lat_deg * 1e7),
        lon=round(lon_deg * 1e7),
        alt=round(alt_m * 1e3),
        relative_alt=0 if math.isnan(height_m) else round(height_m * 1e3),
        vx=round(north_m_s * 100),
        vy=round(east_m_s * 100),
        vz=0,
        hdg=65_535 if math.isnan(heading_deg) else round(heading_deg * 100) % 36_000,
    )


def _velocity_m_s(track: Track, t_s: float) -> tuple[float, float]:
    """Return the velocity (east, north) on the leg that is being flown; outside the track the vehicle stands."""
    leg = int(np.searchsorted(track.t_s, t_s, side="right"))
    if not 0 < leg < len(track.t_s):
        return 0.0, 0.0
    (lat_deg, to_lat_deg), (lon_deg, to_lon_deg) = track.lat_deg[leg - 1 : leg + 1], track.lon_deg[leg - 1 : leg + 1]
    takes_s = track.t_s[leg] - track.t_s[leg - 1]
    velocity = np.array(offset_m(lat_deg, lon_deg, to_lat_deg, to_lon_deg)) / takes_s
    return tuple(np.clip(velocity, -_FASTEST_M_S, _FASTEST_M_S).tolist())


def _attitude(track: Track, t_s: float) -> Message | None:
    """Make the message of the attitude, None where the track does not know it."""
    roll_deg, pitch_deg, heading_deg = (
        _last(track, each, t_s) for each in (track.roll_deg, track.pitch_deg, track.heading_deg)
    )
    if math.isnan(roll_deg + pitch_deg):
        return None
    yaw = 0.0 if math.isnan(heading_deg) else math.remainder(math.radians(heading_deg), math.tau)
    boot_ms = round(t_s * 1000)
    return mavlink.MAVLink_attitude_message(boot_ms, math.radians(roll_deg), math.radians(pitch_deg), yaw, 0, 0, 0)


def _last(track: Track, values: np.ndarray | None, t_s: float) -> float:
    """Return the value at the point of the track that was passed last, NaN where it is unknown."""
    if values is None:
        return math.nan
    return float(values[max(0, np.searchsorted(track.t_s, t_s, side="right") - 1)])


def _gps(position: Message) -> Message:
    """Make the message of a GPS receiver that sees the true position."""
    unknown = 65_535
    return mavlink.MAVLink_gps_raw_int_message(
        0,
        mavlink.GPS_FIX_TYPE_3D_FIX,
        position.lat,
        position.lon,
        position.alt,
        eph=80,
        epv=120,
        vel=unknown,
        cog=unknown,
        satellites_visible=14,
    )


@contextmanager
def _set_by_signals(stop: threading.Event) -> Iterator[None]:
    """Let SIGTERM and SIGINT set `stop`, where this is the main thread (no other may handle signals)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
