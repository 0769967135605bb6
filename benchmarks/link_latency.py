"""How long a fix takes from `send_fix` to the wire, and what an idle link costs: writes results/link.md.

python benchmarks/link_latency.py [--fixes N] [--idle-s S]

The other end is another process, which notes when it has read a fix: its waking up is in the time. It streams what
edgevpr asks an autopilot for: attitude ten times a second and position five times, with heartbeats.
"""

import argparse
import multiprocessing
import os
import pty
import select
import socket
import statistics
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory

import base
from base import Row

from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.conversation import LinkSettings
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.messages import POSITION_FIX, Fix
from edgevpr.mavlink.signing import NOT_SIGNING, Signing, TimeStamps
from edgevpr.mavlink.wire import Message, PacketReader, mavlink

EVERY_S = 0.02  # between two fixes, and a little more each time, so that they meet the streams everywhere
KEY = bytes(range(32))
STREAMS: dict[float, Callable[[], Message]] = {
    1.0: lambda: mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4, 3),
    0.1: lambda: mavlink.MAVLink_attitude_message(0, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0),
    0.2: lambda: mavlink.MAVLink_global_position_int_message(0, 50 * 10**7, 8 * 10**7, 0, 0, 0, 0, 0, 0),
}


_COLUMNS = {
    "link": "{link}",
    "fixes": "{fixes}",
    "median, ms": "{median_ms:.2f}",
    "99 %, ms": "{p99_ms:.2f}",
    "most, ms": "{most_ms:.2f}",
    "idle, % of a core": "{idle_percent:.2f}",
    "messages/s": "{idle_messages_s:.1f}",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fixes", type=int, default=1000)
    parser.add_argument("--idle-s", type=float, default=60.0)
    args = parser.parse_args()
    rows = [row(kind, signed, args.fixes, args.idle_s) for kind in OPENERS for signed in (False, True)]
    found = {**base.made_by(), "rows": rows}
    base.write("link", found, page(found))


def row(kind: str, signed: bool, fixes: int, idle_s: float) -> Row:
    """Measure one kind of link, with or without signing."""
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder, OPENERS[kind]() as (url, descriptor):
        signing = Signing(KEY, TimeStamps(Path(folder) / "time")) if signed else NOT_SIGNING
        processes = multiprocessing.get_context("fork")
        near, far = processes.Pipe()
        peer = processes.Process(target=_peer, args=(kind, descriptor, KEY if signed else b"", far), daemon=True)
        peer.start()
        with Link(parse_link(url), LinkSettings(signing=signing)) as link:
            while not link.listens():
                time.sleep(0.01)
            sent_s = _send(link, fixes)
            time.sleep(1.0)
            heard, cpu_s, begin_s = sum(link.stats().received.values()), time.process_time(), time.monotonic()
            time.sleep(idle_s)
            cpu_s, lasted_s = time.process_time() - cpu_s, time.monotonic() - begin_s
            heard = sum(link.stats().received.values()) - heard
        near.send("end")
        arrived_s = near.recv()
        peer.join()
    took_ms = sorted(1000 * (arrived_s[number] - sent_s[number]) for number in range(fixes))
    return {
        "link": f"{kind}, signed" if signed else kind,
        "fixes": len(took_ms),
        "median_ms": statistics.median(took_ms),
        "p99_ms": took_ms[round(0.99 * (fixes - 1))],
        "most_ms": took_ms[-1],
        "idle_cpu_share": cpu_s / lasted_s,
        "idle_messages_s": heard / lasted_s,
    }


def _send(link: Link, fixes: int) -> list[float]:
    """Send fixes as a flight does, waiting until each has left; return the times of their sending."""
    sent_s = []
    for number in range(fixes):
        time.sleep(EVERY_S + number % 17 / 1000)
        now_s = time.monotonic()
        sending = link.send_fix(Fix(number / 1e7, 8.0, 20.0, now_s))
        sent_s.append(now_s)
        sending.wait(0.02)
    return sent_s


@contextmanager
def _udp() -> Iterator[tuple[str, int]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        yield f"udpout:127.0.0.1:{sock.getsockname()[1]}", sock.fileno()


@contextmanager
def _tcp() -> Iterator[tuple[str, int]]:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        yield f"tcp:127.0.0.1:{sock.getsockname()[1]}", sock.fileno()


@contextmanager
def _serial() -> Iterator[tuple[str, int]]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield f"serial:{os.ttyname(slave)}:921600", master
    os.close(master)
    os.close(slave)


# The kinds of link, each with its address and what the other end reads from.
OPENERS = {"udp": _udp, "tcp": _tcp, "serial (pty)": _serial}


class _Port:
    """The other end: of a UDP socket, a listening TCP socket or the master of a pseudo terminal."""

    def __init__(self, kind: str, descriptor: int) -> None:
        self.descriptor, self._to = descriptor, None
        self._sock = None if kind.startswith("serial") else socket.socket(fileno=descriptor)
        if kind == "tcp":
            self._sock = self._sock.accept()[0]
            self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.descriptor = self._sock.fileno()
        elif kind == "udp":
            self._to = self._sock.recvfrom(4096)[1]

    def read(self) -> bytes:
        return os.read(self.descriptor, 4096)

    def write(self, data: bytes) -> None:
        if self._to:
            self._sock.sendto(data, self._to)
        else:
            os.write(self.descriptor, data)


def _peer(kind: str, descriptor: int, key: bytes, asker: Connection) -> None:
    """Be an autopilot until asked to end, then tell when each fix was read."""
    port, packer, receiver = _Port(kind, descriptor), mavlink.MAVLink(None, 1, 1), PacketReader()
    if key:
        packer.signing.sign_outgoing, packer.signing.secret_key = True, key
        packer.signing.timestamp = int((time.time() - 1_420_070_400 + 120) * 1e5)
    due_s = dict.fromkeys(STREAMS, time.monotonic())
    arrived_s: dict[int, float] = {}
    while True:
        wait_s = max(0.0, min(due_s.values()) - time.monotonic())
        ready, _, _ = select.select([asker, port.descriptor], [], [], wait_s)
        if asker in ready:
            asker.send(arrived_s)
            return
        if port.descriptor in ready:
            data, now_s = port.read(), time.monotonic()
            for message in receiver.feed(data):
                if message.get_type() == "COMMAND_INT":
                    arrived_s[message.x] = now_s
                    port.write(mavlink.MAVLink_command_ack_message(POSITION_FIX, 0).pack(packer))
        for every_s, make in STREAMS.items():
            if time.monotonic() >= due_s[every_s]:
                due_s[every_s] += every_s
                port.write(make().pack(packer))


def page(found: Row) -> str:
    """Return the page for people."""
    rows = [{**row, "idle_percent": 100 * row["idle_cpu_share"]} for row in found["rows"]]
    return f"""# From a fix to the wire, and an idle link

From `send_fix` to the moment when another process on this machine has read the bytes; and the CPU time of a link that
only hears an autopilot and beats.

{base.table(rows, _COLUMNS)}

{base.made_line(found, "python benchmarks/link_latency.py")}
"""


if __name__ == "__main__":
    base.run(main)
