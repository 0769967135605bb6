"""Hostile links: damaged packets, other autopilots, and one that renames itself, reads nothing or answers nothing, each
against a real `Link` over real sockets. The clock alone is stepped, so that a minute takes a moment."""

import logging
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from base import Row
from hostile_bytes import Clock, Maker

from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.conversation import LinkSettings
from edgevpr.mavlink.fixes import MAX_FIX_WAIT_S, Sending
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.messages import POSITION_FIX, Fix, named_values
from edgevpr.mavlink.wire import Message, PacketReader, mavlink

OURS, FOREIGN = 1, 2
BURST, FLOOD = 40, 400  # hostile packets in a second
PATIENCE_S = 1.0  # a fix that leaves at all leaves at once


class _Pilot:
    """An autopilot worked by hand at its end of a socket. `fixes` are the commands that it has read, with the time."""

    def __init__(self, sock: socket.socket, system_id: int = OURS) -> None:
        sock.setblocking(False)
        self.system_id, self.fixes = system_id, []
        self._sock, self._receiver = sock, PacketReader()

    def send(self, packet: bytes) -> None:
        with suppress(OSError):
            self._sock.send(packet)

    def say(self, message: Message, component_id: int = 1) -> None:
        self.send(message.pack(mavlink.MAVLink(None, self.system_id, component_id)))

    def beat(self) -> None:
        self.say(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4, 3))

    def read(self, now_s: float, *, answers: bool) -> None:
        """Read all that has come, and answer every TIMESYNC and, if so wished, every fix of it."""
        with suppress(OSError):
            while data := self._sock.recv(65_536):
                for message in self._receiver.feed(data):
                    if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                        self.say(mavlink.MAVLink_timesync_message(round(1e9 * now_s) + 1, message.ts1))
                    if message.get_type() == "COMMAND_INT":
                        self.fixes.append((message, now_s))
                        if answers:
                            self.say(mavlink.MAVLink_command_ack_message(POSITION_FIX, 0))

    def close(self) -> None:
        self._sock.close()


class _Bench:
    """A link, the autopilots that it knows, and the fixes that it was given."""

    def __init__(self, link: Link, clock: Clock, failures: list[str]) -> None:
        self.link, self.clock, self._failures = link, clock, failures
        self.pilots: list[_Pilot] = []
        self._sendings: list[Sending] = []

    def second(self, *speaking: _Pilot, reads: bool = True, answers: bool = True, fixes: int = 1) -> None:
        """Let a second pass: those who speak beat, fixes are offered, and what has left is read."""
        for _ in range(fixes):
            self.clock.now_s += 1 / fixes
            for pilot in speaking:
                pilot.beat()
            self._wait_until_heard()
            number = len(self._sendings)
            sending = self.link.send_fix(Fix(10.0 + number / 1e5, 8.0, 20.0, self.clock.now_s))
            self._sendings.append(sending)
            told = {"vpr_place": number, "vpr_score": 0.5, "vpr_cpu": 0.5, "vpr_mah": 1.0}
            self.link.send(*named_values(self.clock.now_s, **told))
            sending.wait(PATIENCE_S if self.link.listens() else 0.0)
            if reads:
                self.read(answers=answers)

    def read(self, *, answers: bool = True) -> None:
        for pilot in self.pilots:
            pilot.read(self.clock.now_s, answers=answers)

    def row(
        self, kind: str, tried: int, ours: Callable[[Message], bool] = lambda fix: fix.target_system == OURS
    ) -> Row:
        """Count what has left; the first pilot is ours, and `ours` tells which addresses are. `fixes` and `left` are
        the fixes offered to the link and those that reached an autopilot. `foreign` of these came to another than ours
        or were addressed to another, `late` had waited longer than `max_fix_age_s` or had been reported as not sent,
        and `oldest_s` is the age of the oldest when its reader read it."""
        unsent = {round(each.fix.lat_deg * 1e7) for each in self._sendings if each.sent is False}
        found = [(pilot, fix, now_s) for pilot in self.pilots for fix, now_s in pilot.fixes]
        return {
            "kind": kind,
            "tried": tried,
            "fixes": len(self._sendings),
            "left": len(found),
            "foreign": sum(pilot is not self.pilots[0] or not ours(fix) for pilot, fix, _ in found),
            "late": sum(fix.param2 > MAX_FIX_WAIT_S + 0.001 or fix.x in unsent for _, fix, _ in found),
            "oldest_s": round(max((now_s - fix.param1 + fix.param2 for _, fix, now_s in found), default=0.0), 1),
            "exceptions": len(self._failures) + (not self.link._thread.is_alive()),
        }

    def _wait_until_heard(self) -> None:
        give_up_s = time.monotonic() + 0.02
        while not self.link.listens() and time.monotonic() < give_up_s:
            time.sleep(0.001)


@contextmanager
def _bench(*systems: int, tcp: bool = False, narrow: bool = False) -> Iterator[_Bench]:
    """Open a link and its autopilots: over UDP, each at a socket of its own, or over TCP, where there is one; a narrow
    one takes few bytes unless it reads."""
    failures: list[str] = []
    handler = logging.Handler(logging.ERROR)
    handler.emit = lambda record: failures.append(record.getMessage())
    logger, hook = logging.getLogger("edgevpr.mavlink"), threading.excepthook
    logger.addHandler(handler)
    logger.propagate = False  # thousands of warnings are what is wanted
    threading.excepthook = lambda args: failures.append(repr(args.exc_value))
    clock = Clock()
    kind, style = ("tcp", socket.SOCK_STREAM) if tcp else ("udpin", socket.SOCK_DGRAM)
    with socket.socket(socket.AF_INET, style) as listener:
        listener.bind(("127.0.0.1", 0))
        where = listener.getsockname()
        if tcp:
            if narrow:
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            listener.listen()
        else:
            listener.close()
        with Link(parse_link(f"{kind}:127.0.0.1:{where[1]}"), LinkSettings(clock=clock)) as link:
            bench = _Bench(link, clock, failures)
            for system_id in systems:
                sock = listener.accept()[0] if tcp else socket.socket(socket.AF_INET, style)
                if not tcp:
                    sock.connect(where)
                bench.pilots.append(_Pilot(sock, system_id))
            yield bench
            for pilot in bench.pilots:
                pilot.close()
    threading.excepthook = hook
    logger.propagate = True
    logger.removeHandler(handler)


def _packet(rng: random.Random, system_id: int, component_id: int = 1) -> bytes:
    """Make a valid message of any kind with random content."""
    return Maker(rng, 0).packet(system_id=system_id, component_id=component_id)


def _beat(rng: random.Random, system_id: int) -> bytes:
    message = mavlink.MAVLink_heartbeat_message(rng.randrange(40), rng.randrange(21), 1, 0, 4, 3)
    return message.pack(mavlink.MAVLink(None, system_id, 1))


def _foreign(rng: random.Random) -> bytes:
    system_id = rng.randrange(2, 256)
    return rng.choice((_beat(rng, system_id), _packet(rng, system_id)))


SECOND = "a second socket with our number"
# Each kind makes packets that go over our autopilot's own socket and over another one, in turn; those of the second
# socket over that one only.
PACKETS: dict[str, tuple[int, Callable[[random.Random], bytes]]] = {
    "any message of other components": (BURST, lambda rng: _packet(rng, OURS, rng.randrange(2, 256))),
    "any message of other systems": (BURST, _foreign),
    "heartbeats of other systems": (BURST, lambda rng: _beat(rng, rng.randrange(2, 256))),
    "a flood of any message": (FLOOD, lambda rng: _packet(rng, rng.randrange(256))),
    SECOND: (BURST, lambda rng: rng.choice((_beat(rng, OURS), _packet(rng, OURS)))),
}


def _thrown(kind: str, make: Callable[[random.Random], bytes], count: int, rng: random.Random, burst: int) -> Row:
    with _bench(OURS, OURS) as bench:
        ours, other = bench.pilots
        bench.second(ours)
        for begin in range(0, count, burst):
            for number in range(min(burst, count - begin)):
                (ours if number % 2 and kind != SECOND else other).send(make(rng))
            bench.second(ours)
        return bench.row(kind, count)


def _renamed(count: int, rng: random.Random) -> Row:
    """Our autopilot takes another number every 45 s; nothing may be addressed but to the last one or this one."""
    times, right = max(1, count // BURST), set()
    with _bench(OURS) as bench:
        (ours,) = bench.pilots
        for _ in range(times):
            numbers = ours.system_id, rng.choice([each for each in range(1, 256) if each != ours.system_id])
            ours.system_id, first = numbers[1], len(ours.fixes)
            for _ in range(45):
                bench.second(ours)
            right |= {fix.x for fix, _ in ours.fixes[first:] if fix.target_system in numbers}
        return bench.row("our autopilot renames itself", times, ours=lambda fix: fix.x in right)


def _fallen_silent(count: int, rng: random.Random) -> Row:
    """Two vehicles are heard, then only the other one."""
    times = max(1, count // BURST)
    with _bench(OURS, FOREIGN) as bench:
        ours, other = bench.pilots
        for _ in range(times):
            for _ in range(3):
                bench.second(ours, other)
            for _ in range(rng.randrange(20, 60)):
                bench.second(other)
        return bench.row("ours falls silent, another vehicle speaks on", times)


def _reads_nothing(*, narrow: bool) -> Row:
    """Our autopilot beats but reads nothing for a minute, while three fixes a second are offered, and then reads."""
    with _bench(OURS, tcp=True, narrow=narrow) as bench:
        for _ in range(60):
            bench.second(*bench.pilots, reads=False, fixes=3)
        bench.read()
        return bench.row(f"reads nothing for 60 s ({'small' if narrow else 'usual'} buffer)", 1)


def _answers_nothing() -> Row:
    """Our autopilot reads but answers no fix for ten minutes."""
    with _bench(OURS) as bench:
        for _ in range(600):
            bench.second(*bench.pilots, answers=False)
        return bench.row("answers nothing for 600 s", 1)


def run(count: int, seed: int) -> list[Row]:
    """Try every kind of hostile link: `count` packets of each, or longer stories that take about as long."""
    rng = random.Random(seed)
    return [
        *(_thrown(kind, make, count, rng, burst) for kind, (burst, make) in PACKETS.items()),
        _renamed(count, rng),
        _fallen_silent(count, rng),
        _reads_nothing(narrow=False),
        _reads_nothing(narrow=True),
        _answers_nothing(),
    ]
