"""Ports of four kinds: UDP out, UDP in, TCP and serial. Unlike pymavlink's own connections, which may spin, hang or
raise, none of them blocks once it is open, and all handle faults in the same way. A `PacketWriter` writes packets to an
open port, and ensures that no position fix leaves late from a buffer, whether ours or the operating system's."""

import errno
import fcntl
import os
import socket
import stat
import struct
import termios
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress

from edgevpr.core.errors import LinkAddressError, LinkError
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.address import LinkAddress, Sender
from edgevpr.mavlink.fixes import FixTransmission

CONNECT_TIMEOUT_S = 1.0
TCP_TIMEOUT_MS = 1000  # if bytes are not acknowledged in this time, the connection is closed and they are lost
TCP_BUFFER_BYTES = 8192  # doubled by the system; about 30 messages, while the default is megabytes
READ_BYTES = 65_536
LINK_LOST = Reason(ReasonCode.LINK_LOST)
WRITE_TIMEOUT_S = 0.5  # a port that accepts no bytes for this long is reopened: the waiting bytes would leave late


class Port:
    """Base class of all ports. After an error the owner closes the port and opens a new one. `connected`: there is a
    receiver to send to. `sender`: source address of the last bytes; None if there can be only one."""

    connected = True
    sender: Sender | None = None
    _loss_message = "the other end closed the connection"

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._sock = sock

    def fileno(self) -> int:
        """Return the file descriptor, for `select`."""
        return self._sock.fileno()

    def read(self) -> bytes:
        """Return the bytes received (b"": none), without waiting. Raises OSError if the connection is lost."""
        with suppress(BlockingIOError):
            data = os.read(self.fileno(), READ_BYTES)
            if not data:
                raise ConnectionError(self._loss_message)
            return data
        return b""

    def write(self, data: bytes) -> int:
        """Write as many bytes as fit without waiting; return their number. Raises OSError if the connection is lost."""
        with suppress(BlockingIOError):
            return os.write(self.fileno(), data)
        return 0

    def adopt_sender_as_peer(self) -> None:
        """From now on, send to the sender of the last bytes read. No effect if there can be only one sender."""

    def unsent(self) -> int:
        """Return the number of written bytes that have not left the system or, over TCP, are not acknowledged."""
        return 0

    def discard_on_close(self) -> None:
        """Make `close` discard unsent bytes instead of sending them later."""

    def close(self) -> None:
        self._sock.close()


def _open_udp(attach: Callable[[socket.socket, tuple[str, int]], None], host: str, port: int) -> socket.socket:
    """Return a UDP socket attached to an address by `attach`: `bind` or `connect`. Close the socket if this fails."""
    with ExitStack() as stack:
        sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        attach(sock, (host, port))
        stack.pop_all()
    return sock


class UdpOutPort(Port):
    """A UDP socket connected to one address: the operating system drops packets from any other."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(_open_udp(socket.socket.connect, host, port))

    # A datagram that no program received makes the next call fail once, so `write` tries twice.

    def read(self) -> bytes:
        with suppress(BlockingIOError, ConnectionRefusedError):
            return self._sock.recv(READ_BYTES)
        return b""

    def write(self, data: bytes) -> int:
        for _ in range(2):  # UDP reports the refusal of an earlier datagram: try again
            with suppress(ConnectionRefusedError):
                return super().write(data)
        return 0


class UdpInPort(Port):
    """A listening UDP socket. It sends to the first sender until `adopt_sender_as_peer` selects another one."""

    def __init__(self, host: str, port: int) -> None:
        # No SO_REUSEADDR: with it, a second program on the port would silently receive the first one's datagrams.
        super().__init__(_open_udp(socket.socket.bind, host, port))
        self._peer: Sender | None = None
        self.connected = False

    def read(self) -> bytes:
        with suppress(BlockingIOError):
            data, self.sender = self._sock.recvfrom(READ_BYTES)
            if self._peer is None:
                self.adopt_sender_as_peer()
            return data
        return b""

    def write(self, data: bytes) -> int:
        with suppress(BlockingIOError):
            return self._sock.sendto(data, self._peer) if self._peer else 0
        return 0

    def adopt_sender_as_peer(self) -> None:
        self._peer, self.connected = self.sender, self.sender is not None


class TcpPort(Port):
    """A TCP connection to a server."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(socket.create_connection((host, port), CONNECT_TIMEOUT_S))
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, TCP_TIMEOUT_MS)
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, TCP_BUFFER_BYTES)

    def unsent(self) -> int:
        # SIOCOUTQ, which has the same value as TIOCOUTQ.
        return int.from_bytes(fcntl.ioctl(self._sock, termios.TIOCOUTQ, bytes(4)), "little")

    def discard_on_close(self) -> None:
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


class SerialPort(Port):
    """A serial port, written through its file descriptor: pyserial's own write spins when the buffer is full."""

    _loss_message = "the device was disconnected"

    def __init__(self, device: str, baud: int) -> None:
        import serial  # not at the top, because other kinds of links do not need it

        if not stat.S_ISCHR(os.stat(device).st_mode):
            raise ValueError("it is not a serial device")
        try:
            self._port = serial.Serial(device, baud, timeout=0, exclusive=True)
        except termios.error as error:  # not a subclass of OSError
            raise OSError(*error.args) from error
        except serial.SerialException as error:
            if isinstance(error.__context__, termios.error) and error.__context__.args[0] == errno.ENOTTY:
                raise ValueError("it is not a serial device") from error
            raise

    def fileno(self) -> int:
        return int(self._port.fileno())

    def unsent(self) -> int:
        return int(self._port.out_waiting)

    def close(self) -> None:
        with suppress(OSError, termios.error):
            if self.unsent():
                # Bytes still in the buffer must neither leave later nor delay closing the port (by up to 30 s).
                self._port.reset_output_buffer()
        self._port.close()


_PORT_TYPES: dict[str, Callable[[str, int], Port]] = {
    "udpout": UdpOutPort,
    "udpin": UdpInPort,
    "tcp": TcpPort,
    "serial": SerialPort,
}
_ADVICE = {  # by error, and whether the link is serial
    (errno.EADDRINUSE, False): "the port is in use by another program: stop that program, or use another port",
    (errno.EWOULDBLOCK, True): "the device is in use by another program: stop that program",
    (errno.EACCES, True): "this user has no access: run `edgevpr doctor` to see what to change (often group `dialout`)",
    (errno.EACCES, False): "permission denied: use a port above 1023 and the address of a single host",
}


def open_port(address: LinkAddress) -> Port:
    """Open the port of a link. Raises LinkAddressError for a wrong address, LinkError for another fault that the user
    must correct (a port in use, no permission), and OSError for a fault that may clear by itself (no device)."""
    is_serial = address.kind == "serial"
    try:
        return _PORT_TYPES[address.kind](address.target, address.number)
    except (socket.gaierror, UnicodeError) as error:
        # The host may be found later: no name server has answered, or a .local host has yet to announce itself.
        is_unresolved = isinstance(error, socket.gaierror) and error.errno != socket.EAI_NONAME
        kind = LinkError if is_unresolved or address.target.endswith(".local") else LinkAddressError
        raise kind(f"{address}: host {address.target!r} not found: correct it, or use an IP address.") from error
    except ValueError as error:
        raise LinkAddressError(f"{address} cannot be opened ({error}): correct the device or baud rate.") from error
    except OSError as error:
        if not (advice := _ADVICE.get((error.errno or 0, is_serial))):
            raise
        kind = LinkAddressError if error.errno == errno.EACCES and not is_serial else LinkError
        raise kind(f"{address}: {advice}.") from error


class PacketWriter:
    """Writes packets to a port, one at a time. A fix counts as sent when all its bytes have left the operating system
    (over TCP: when they are acknowledged). If not by its `due_s`, `take_sent_fixes` raises ConnectionError, and closing
    the port then discards the bytes. `unsent`: the bytes of the last packet not yet accepted."""

    def __init__(self, port: Port, clock: Callable[[], float]) -> None:
        self.port, self._clock = port, clock
        self.unsent = b""
        self._accepted_bytes = 0
        self.pending_fixes: deque[tuple[int, FixTransmission]] = deque()  # with `_accepted_bytes` at their last byte
        self._blocked_since_s: float | None = None

    @property
    def is_idle(self) -> bool:
        """True if every byte has left the operating system."""
        return not self.unsent and self.port.unsent() == 0

    def put(self, packet: bytes, transmission: FixTransmission | None) -> None:
        """Set the next packet, and the fix in it, if any. The port must have accepted the previous packet in full."""
        self.unsent = packet
        if transmission:
            self.pending_fixes.append((self._accepted_bytes + len(packet), transmission))

    def write(self) -> None:
        """Write what the port accepts without blocking. Raises OSError if it is lost, or accepts nothing for 0.5 s."""
        if not self.unsent:
            return
        count = self.port.write(self.unsent)
        self.unsent = self.unsent[count:]
        self._accepted_bytes += count
        if count:
            self._blocked_since_s = None
        elif self._blocked_since_s is None:
            self._blocked_since_s = self._clock()
        elif self._clock() - self._blocked_since_s > WRITE_TIMEOUT_S:
            raise ConnectionError("the port accepts no more bytes")

    def take_sent_fixes(self) -> list[FixTransmission]:
        """Return the fixes sent since the last call. Raises ConnectionError if the next one is overdue."""
        sent_fixes = []
        # Read the clock before the port: if the clock jumps in between, a fix that has just left must not be rejected.
        now_s = self._clock()
        sent_bytes = self._accepted_bytes - self.port.unsent() if self.pending_fixes else 0
        while self.pending_fixes and self.pending_fixes[0][0] <= sent_bytes:
            sent_fixes.append(self.pending_fixes.popleft()[1])
            sent_fixes[-1].settle(True)
        if not sent_fixes and self.pending_fixes and now_s > self.pending_fixes[0][1].due_s:
            raise ConnectionError("a position fix has waited too long in its buffer")
        return sent_fixes

    def close(self) -> int:
        """Close the port, discard all unsent bytes, and return the number of fixes in them."""
        with suppress(OSError):
            if not self.is_idle:
                self.port.discard_on_close()
        self.port.close()
        for _, transmission in self.pending_fixes:
            transmission.settle(False, LINK_LOST)
        return len(self.pending_fixes)
