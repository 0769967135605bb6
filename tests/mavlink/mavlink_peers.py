"""Other ends for links: a hand-driven autopilot, sockets to speak through, and a serial cable."""

import os
import pty
import select
import socket
import threading
import tty
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path

from loopback import PATIENCE_S, wait_until
from simulated.autopilot import AutopilotSummary, run_autopilot

from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.conversation import LinkSettings
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.wire import PacketReader, mavlink


def make_link(url: str, **settings) -> Link:
    """Make a link by its address as a user writes it, and its settings."""
    return Link(parse_link(url), LinkSettings(**settings))


class Peer:
    """An autopilot worked by hand over a socket-like `port` (recv, send); it sees nothing but what it reads. It answers
    TIMESYNC as if it had booted with us."""

    def __init__(self, port, system_id: int = 1) -> None:
        self.port = port
        self.seen = []
        self.receiver = PacketReader()
        self._senders = {}
        self._system_id, self._timesyncs = system_id, 0

    def synchronise(self, link: Link) -> None:
        """Answer a TIMESYNC, without which no fix leaves."""

        def is_known() -> bool:
            return link.conversation.autopilot.stamp_s(0.0) is not None

        while not is_known() and not self._timesyncs:
            self.read()
        wait_until(is_known, "learning the autopilot's time")

    def send(self, message, system_id: int | None = None, component_id: int = 1) -> None:
        sender = (system_id or self._system_id, component_id)
        packer = self._senders.setdefault(sender, mavlink.MAVLink(None, *sender))
        self.port.send(message.pack(packer))
        packer.seq = (packer.seq + 1) % 256

    def lose(self, packets: int, system_id: int | None = None, component_id: int = 1) -> None:
        """Go on as if so many packets had been lost on the way."""
        self._senders[system_id or self._system_id, component_id].seq += packets

    def heartbeat(self, **sender: int) -> None:
        self.send(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4, 3), **sender)

    def answer_fix(self, result: int, command: int = 43003, to: int = 197, **sender: int) -> None:
        self.send(mavlink.MAVLink_command_ack_message(command, result, target_system=1, target_component=to), **sender)

    def read(self) -> None:
        """Take what comes next."""
        for message in self.receiver.feed(self.port.recv(65_536)):
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self._timesyncs += 1
                self.send(mavlink.MAVLink_timesync_message(message.ts1 + 1, message.ts1), message.get_srcSystem())
            else:
                self.seen.append(message)

    def expect(self, name: str):
        """Read until a message of this name comes; give it and forget it and all before."""
        for _ in range(1000):
            for place, message in enumerate(self.seen):
                if message.get_type() == name:
                    del self.seen[: place + 1]
                    return message
            self.read()
        raise AssertionError(f"no {name} among a thousand reads")

    def expect_text(self, text: str):
        """Read up to the STATUSTEXT `text`; give all that came before it."""
        before = []
        while True:
            while self.seen:
                message = self.seen.pop(0)
                if message.get_type() == "STATUSTEXT" and message.text == text:
                    return before
                before.append(message)
            self.read()


class UdpPort:
    """A UDP socket that sends to `to`, or to whoever spoke last."""

    def __init__(self, own_port: int = 0, to: int | None = None) -> None:
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.settimeout(PATIENCE_S)
        self._sock.bind(("127.0.0.1", own_port))
        self.to = ("127.0.0.1", to) if to else None
        self.number = self._sock.getsockname()[1]

    def recv(self, size: int) -> bytes:
        data, self.to = self._sock.recvfrom(size)
        return data

    def send(self, data: bytes) -> None:
        self._sock.sendto(data, self.to)

    def close(self) -> None:
        self._sock.close()


class TcpServer:
    """A TCP server, which can die and come back on its port."""

    def __init__(self, number: int) -> None:
        self._listener = socket.create_server(("127.0.0.1", number))
        self._listener.settimeout(PATIENCE_S)
        self._clients: list[socket.socket] = []

    def accept(self) -> socket.socket:
        client, _ = self._listener.accept()
        client.settimeout(PATIENCE_S)
        self._clients.append(client)
        return client

    def close(self) -> None:
        for client in self._clients:
            client.close()
        self._listener.close()


class SerialCable:
    """Two pseudo terminals joined back to back, at `folder`/a and `folder`/b while it is plugged in. What nobody reads
    is lost, as on a line without flow control."""

    def __init__(self, folder: Path) -> None:
        self.ends = (folder / "a", folder / "b")

    def plug(self) -> None:
        masters, self._slaves = zip(*(pty.openpty() for _ in self.ends), strict=True)
        for master in masters:
            os.set_blocking(master, False)
        for end, slave in zip(self.ends, self._slaves, strict=True):
            tty.setraw(slave)  # a terminal left as it is would echo
            end.symlink_to(os.ttyname(slave))
        self._cut = threading.Event()
        self._copier = threading.Thread(target=self._copy, args=masters)
        self._copier.start()

    def unplug(self) -> None:
        for end in self.ends:
            end.unlink()
        self._cut.set()
        self._copier.join()
        for slave in self._slaves:
            os.close(slave)

    def _copy(self, a: int, b: int) -> None:
        while not self._cut.is_set():
            for ready in select.select([a, b], [], [], 0.01)[0]:
                with suppress(BlockingIOError):
                    os.write(b if ready == a else a, os.read(ready, 4096))
        os.close(a)
        os.close(b)


class AutopilotThread:
    """The simulated flight controller, until `finish` is called or its line is cut."""

    def __init__(self, link_url: str, **options) -> None:
        self._stop = threading.Event()
        self._ended: Future[AutopilotSummary] = Future()
        threading.Thread(target=self._run, args=(link_url, options), daemon=True).start()

    def _run(self, link_url: str, options: dict) -> None:
        try:
            self._ended.set_result(run_autopilot(link_url, stop=self._stop, **options))
        except Exception as error:  # of the test that waits for it, and of no other
            self._ended.set_exception(error)

    def join(self) -> AutopilotSummary:
        return self._ended.result(PATIENCE_S)

    def finish(self) -> AutopilotSummary:
        self._stop.set()
        return self.join()
