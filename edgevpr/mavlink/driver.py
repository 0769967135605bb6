"""Drives a conversation: moves packets between it and a port. Only the driver's own thread accesses the port."""

import logging
import select
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from edgevpr.core.errors import LinkError
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.conversation import Conversation
from edgevpr.mavlink.ports import PacketWriter, Port, open_port
from edgevpr.mavlink.signing import OLD
from edgevpr.mavlink.turns import Turns

MAX_SLEEP_S = 0.25  # longest sleep of the thread, if nothing wakes it
FIRST_RETRY_S = 0.2
MAX_RETRY_S = 2.0
DEPARTURE_CHECK_S = 0.01  # interval of checking whether a fix has left the operating system
FLUSH_TIMEOUT_S = 0.5

PortState = tuple[bool, str | None]  # whether it is connected, and the reason if not

log = logging.getLogger(__name__)


class Driver(Protocol):
    """The interface of a link to its driver. No method waits for the other end."""

    def start(self) -> None:
        """Start to send and receive. Raises LinkError for a fault that only the user can correct."""

    def wake(self) -> None:
        """Wake the driver: a message is queued."""

    def state(self) -> PortState:
        """Return the state of the port."""

    def close(self) -> None:
        """Send queued messages and wait for answers to fixes, for at most half a second each, then close the port."""


DriverMaker = Callable[[LinkAddress, Conversation, Turns], Driver]


class PortDriver:
    """The driver of a real port, which it reopens whenever the connection is lost. A missing device or server is not an
    error: the thread keeps trying to open it, and `state` gives the reason."""

    def __init__(self, address: LinkAddress, conversation: Conversation, turns: Turns) -> None:
        self._address, self._conversation, self._turns = address, conversation, turns
        self._settings = conversation.settings
        self._writer: PacketWriter | None = None
        self._retry_s = FIRST_RETRY_S
        self._trouble: str | None = None
        self._closing = threading.Event()
        self._wake_receiver, self._wake_sender = socket.socketpair()  # wakes the thread when there is something to send
        self._wake_sender.setblocking(False)
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)

    def start(self) -> None:
        try:
            self._writer = self._open()
        except OSError as error:
            self._record_trouble(error)
        except LinkError:
            self.close()
            raise
        self._thread.start()

    def wake(self) -> None:
        with suppress(OSError):  # a wake-up is already pending, or the link is closed
            self._wake_sender.send(b"!")

    def state(self) -> PortState:
        writer = self._writer
        return writer is not None and writer.port.connected, self._trouble

    def close(self) -> None:
        self._closing.set()
        self.wake()
        if self._thread.ident is None:  # never started
            self._close_all()
        else:
            self._thread.join(2 * FLUSH_TIMEOUT_S)

    def _open(self) -> PacketWriter:
        return PacketWriter(open_port(self._address), self._settings.clock)

    # The methods below run in the driver's own thread.

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                if self._writer is None:
                    self._reopen()
                else:
                    self._exchange_data(self._writer, timeout_s=MAX_SLEEP_S)
            except (OSError, LinkError) as error:
                self._handle_loss(error)
            except Exception as error:  # reopen the link instead of losing it
                log.exception("the link failed")
                self._handle_loss(error)
        self._flush()
        self._close_all()

    def _reopen(self) -> None:
        if self._closing.wait(self._retry_s):
            return
        self._retry_s = min(2 * self._retry_s, MAX_RETRY_S)
        with self._turns.take_link_turn():
            self._conversation.drop_stale()
        self._writer = self._open()

    def _exchange_data(self, writer: PacketWriter, timeout_s: float) -> None:
        """Write as much as the port accepts, wait up to `timeout_s` for data or a wake-up, then read."""
        with self._turns.take_link_turn():
            if writer.port.connected:
                self._transmit(writer)
            self._conversation.announce_changes()
        reading: list[Port | socket.socket] = [writer.port, self._wake_receiver]
        writing = [writer.port] if writer.unsent else []
        timeout_s = min(timeout_s, DEPARTURE_CHECK_S) if writer.pending_fixes else self._conversation.wait_s(timeout_s)
        readable, _, _ = select.select(reading, writing, [], timeout_s)
        if self._wake_receiver in readable:
            self._wake_receiver.recv(4096)
        if writer.port in readable:
            self._receive(writer)

    def _receive(self, writer: PacketWriter) -> None:
        data = writer.port.read()
        if data:
            self._retry_s = FIRST_RETRY_S
            if self._trouble is not None:
                log.info("%s is back", self._address)
                self._trouble = None
        with self._turns.take_link_turn():
            self._count_sent_fixes(writer)  # before their answers are read
            self._settings.signing.verdicts.clear()
            has_heartbeat = self._conversation.handle(data, self._turns.now_s(), writer.port.sender)
            # An autopilot that has the key but an old clock learns the time from our signed messages.
            has_old_clock = OLD in self._settings.signing.verdicts
            is_behind = has_old_clock and not self._conversation.autopilot.is_alive(self._turns.now_s())
        if has_heartbeat or is_behind:
            writer.port.adopt_sender_as_peer()

    def _transmit(self, writer: PacketWriter) -> None:
        while True:
            # Check before writing: the rest of a fix that has waited too long must not be written.
            self._count_sent_fixes(writer)
            if not writer.unsent:
                outgoing = self._conversation.next_packet()
                if outgoing is None:
                    return
                writer.put(*outgoing)
            writer.write()
            if writer.unsent:
                return

    def _count_sent_fixes(self, writer: PacketWriter) -> None:
        if sent_fixes := writer.take_sent_fixes():
            self._conversation.count_sent_fixes(sent_fixes)

    def _handle_loss(self, error: Exception) -> None:
        with self._turns.take_link_turn():
            self._conversation.handle_port_loss(self._close_writer())
        self._record_trouble(error)

    def _close_writer(self) -> int:
        """Close the port, and return the number of fixes discarded with it."""
        writer, self._writer = self._writer, None
        return writer.close() if writer else 0

    def _record_trouble(self, error: Exception) -> None:
        reason = getattr(error, "strerror", None) or str(error)
        if reason != self._trouble:
            self._trouble = reason
            log.warning("%s is not connected (%s): retrying", self._address, reason)

    def _flush(self) -> None:
        deadline_s = time.monotonic() + FLUSH_TIMEOUT_S
        with suppress(OSError):
            while self._writer and self._writer.port.connected and time.monotonic() < deadline_s:
                self._exchange_data(self._writer, timeout_s=0.01)
                if not self._conversation.has_pending and self._writer.is_idle:
                    break

    def _close_all(self) -> None:
        with self._turns.take_link_turn():
            self._close_writer()
            self._conversation.end()
        self._wake_receiver.close()
        self._wake_sender.close()
