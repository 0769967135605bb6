"""A simulated autopilot at the other end of a MAVLink link, as strict as a real one: `FlightController` connected to a
port and to the clock. Used by tests, and by people: `python tests/simulated/autopilot.py --help`. A *companion* is an
onboard computer, such as the one that runs edgevpr."""

import json
import logging
import select
import signal
import sys
import threading
import time
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType

from edgevpr.core.errors import EdgevprError, LinkError
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.messages import AUTOPILOT
from edgevpr.mavlink.ports import Port, open_port
from edgevpr.mavlink.wire import Message, PacketReader, mavlink

sys.path.append(str(Path(__file__).parents[1]))
from simulated.controller import STEP_S, VEHICLES, FlightController
from simulated.motion import AlongTrack, FlownTrack, Motion, read_track

_QUESTIONS = {"HEARTBEAT", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PING", "TIMESYNC"}
_MAX_WAITING_BYTES = 65_536  # of a port that accepts none: messages beyond that are lost

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotSummary:
    """Everything that the simulated autopilot received. `companion` is the last companion heard, as "system/component"
    (None: none). `fixes_failed` counts fixes that came at a time when none is accepted, as while there is GPS;
    `fixes_denied` counts those with a wrong form. `messages` counts all messages by name."""

    companion: str | None
    fixes_accepted: int
    fixes_failed: int
    fixes_denied: int
    lost_packets: int
    bad_bytes: int
    messages: dict[str, int]


def run_autopilot(
    link_url: str,
    stop: threading.Event | None = None,
    *,
    track: FlownTrack | None = None,
    vehicle: str = "arduplane",
    gps: bool = False,
    parameters: Mapping[str, float] = MappingProxyType({}),
) -> AutopilotSummary:
    """Simulate an autopilot at `link_url` until `stop` is set, Ctrl-C comes, or the link is lost; return what it
    received. Its UTC is that of this machine.

    With a `track` the vehicle flies along it from the first message of a companion that does more than ask for
    information, and stays at its end. Without one, its position is unknown and never reported. With `gps` it has GPS,
    and accepts no fix. `parameters` are set before the start. Raises LinkError if the link cannot be opened, KeyError
    for an unknown parameter."""
    controller = FlightController(vehicle, AlongTrack(track) if track else Motion(), gps=gps, start_utc_s=time.time())
    for name, value in parameters.items():
        controller.set(name, value)
    return serve(controller, link_url, stop or threading.Event())


def serve(controller: FlightController, link_url: str, stop: threading.Event) -> AutopilotSummary:
    """Run this controller at `link_url` until `stop` is set, Ctrl-C comes, or the link is lost; return what it
    received. Raises LinkError if the link cannot be opened."""
    address = parse_link(link_url)
    try:
        port = open_port(address)
    except OSError as error:
        raise LinkError(f"{address}: it cannot be opened ({error.strerror or error}): is the other end up?") from error
    log.info("%s is up at %s", controller, address)
    conversation = _Conversation(port, controller)
    try:
        conversation.run(stop)
    except KeyboardInterrupt:
        log.debug("%s is asked to end", address)
    except OSError as error:
        log.warning("%s was lost (%s)", address, error)
    finally:
        port.close()
    return conversation.summary()


class _Conversation:
    """Connects a `FlightController` to a port: sends its messages, and passes on and counts those received."""

    def __init__(self, port: Port, controller: FlightController) -> None:
        self._port, self._controller = port, controller
        self._packer = mavlink.MAVLink(None, srcSystem=controller.system_id, srcComponent=AUTOPILOT)
        self._receiver = PacketReader()
        self._companion: str | None = None
        self._next_seq: dict[str, int] = {}
        self._lost_packets = 0
        self._waiting = b""

    def run(self, stop: threading.Event) -> None:
        """Advance by the clock and answer until `stop` is set."""
        start_s = time.monotonic()
        while not stop.is_set():
            self._send(self._controller.advance(time.monotonic() - start_s))
            readable, _, _ = select.select([self._port], [], [], STEP_S)
            for message in self._receiver.feed(self._port.read()) if readable else ():
                self._count(message)
                self._send(self._controller.receive(message))

    def summary(self) -> AutopilotSummary:
        """Return what was received."""
        answers = Counter(self._controller.answers)
        accepted, denied = answers[mavlink.MAV_RESULT_ACCEPTED], answers[mavlink.MAV_RESULT_DENIED]
        return AutopilotSummary(
            companion=self._companion,
            fixes_accepted=accepted,
            fixes_failed=answers.total() - accepted - denied,
            fixes_denied=denied,
            lost_packets=self._lost_packets,
            bad_bytes=self._receiver.bad_bytes,
            messages=dict(self._receiver.received),
        )

    def _count(self, message: Message) -> None:
        """Count a received message, and start the motion along the track if a companion does more than ask for
        information. The last companion heard receives the answers or, before there is one, any sender of heartbeats."""
        sender = f"{message.get_srcSystem()}/{message.get_srcComponent()}"
        self._lost_packets += (message.get_seq() - self._next_seq.get(sender, message.get_seq())) % 256
        self._next_seq[sender] = (message.get_seq() + 1) % 256
        if sender == self._companion and not _is_question(message):
            self._controller.brain.motion.begin(self._controller.brain.now_s)
        if message.get_type() == "HEARTBEAT":
            is_companion = message.type == mavlink.MAV_TYPE_ONBOARD_CONTROLLER
            if is_companion or self._companion is None:
                self._port.adopt_sender_as_peer()
            self._companion = sender if is_companion else self._companion

    def _send(self, messages: list[Message]) -> None:
        for message in messages if self._port.connected else ():
            packet = message.pack(self._packer)
            self._packer.seq = (self._packer.seq + 1) % 256
            if len(self._waiting) < _MAX_WAITING_BYTES:
                data = self._waiting + packet
                self._waiting = data[self._port.write(data) :]


def _is_question(message: Message) -> bool:
    """Return True if a message only requests information."""
    if message.get_type() in ("COMMAND_INT", "COMMAND_LONG"):
        return bool(message.command == mavlink.MAV_CMD_REQUEST_MESSAGE)
    return message.get_type() in _QUESTIONS


def make_parser() -> ArgumentParser:
    """Make the parser of this file's command line."""
    parser = ArgumentParser(description="Simulate an autopilot that answers and counts, until Ctrl-C.")
    parser.add_argument("--link", default="udpin:127.0.0.1:14550", metavar="URL", help="address to listen at")
    parser.add_argument("--track", metavar="CSV", help="positions.csv to fly along once a flight is heard")
    parser.add_argument("--vehicle", choices=VEHICLES, default="arduplane")
    parser.add_argument("--no-gps", action="store_true", help="start without GPS, as always without --track")
    parser.add_argument("--param", action="append", default=[], type=_parse, metavar="KEY=VALUE")
    return parser


def _parse(pair: str) -> tuple[str, float]:
    name, _, value = pair.partition("=")
    return name, float(value)


def main() -> None:
    """Simulate an autopilot by the command line, and print what it received, as JSON."""
    parser = make_parser()
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: it prints what it received
    try:
        track = read_track(args.track) if args.track else None
        gps = track is not None and not args.no_gps
        summary = run_autopilot(args.link, track=track, vehicle=args.vehicle, gps=gps, parameters=dict(args.param))
    except EdgevprError as error:
        parser.error(str(error))
    except KeyError as error:
        parser.error(f"the vehicle has no parameter {error}")
    print(json.dumps(asdict(summary), indent=2))


if __name__ == "__main__":
    main()
