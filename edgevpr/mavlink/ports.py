"""Ports of four kinds: UDP out, UDP in, TCP and serial. None of them blocks once it is open. Used by `link`, `asking`
and the simulated autopilot.

This thin layer over `socket` and pyserial has the same behaviour after every fault. pymavlink's own connections may
spin, hang or raise.
"""

import errno
import fcntl
import os
import socket
import stat
import struct
import termios
from collections.abc import Callable
from contextlib import suppress

from edgevpr.core.errors import LinkAddressError, LinkError
from edgevpr.mavlink.address import LinkAddress, Sender

CONNECT_TIMEOUT_S = 1.0
TCP_GIVE_UP_MS = 1000  # if the other end has not confirmed bytes by then, the connection is closed and they are lost
TCP_SEND_BYTES = 8192  # doubled by the system: some 30 messages; left to itself it takes megabytes
READ_BYTES = 65_536


class Port:
    """The base of all ports. After an error the owner closes the port and opens a new one. `connected`: there is a
    receiver to which `write` can send. `sender`: the address from which the last bytes came; None if there can be only
    one."""

    connected = True
    sender: Sender | None = None
    _end = "the other end closed the connection"

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._sock = sock

    def fileno(self) -> int:
        """Return the file descriptor, for `select`."""
        return self._sock.fileno()

    def read(self) -> bytes:
        """Return the bytes that have arrived (b"": none), without waiting. Raises OSError if the connection is lost."""
        with suppress(BlockingIOError):
            data = os.read(self.fileno(), READ_BYTES)
            if not data:
                raise ConnectionError(self._end)
            return data
        return b""

    def write(self, data: bytes) -> int:
        """Write the bytes that fit without waiting; return their number. Raises OSError if the connection is lost."""
        with suppress(BlockingIOError):
            return os.write(self.fileno(), data)
        return 0

    def answer_sender(self) -> None:
        """From now on send to the sender of the last bytes read. No effect if there can be only one sender."""

    def unsent(self) -> int:
        """Return the number of bytes written that have not left the operating system, or (TCP) are not confirmed."""
        return 0

    def throw_away(self) -> None:
        """Make `close` discard the bytes that have not left, instead of letting them leave later."""

    def close(self) -> None:
        """Close the port."""
        self._sock.close()


class UdpOutPort(Port):
    """A UDP socket that is connected to one address: the operating system drops packets from any other."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(_udp_socket(socket.socket.connect, host, port))

    # A datagram that no program received makes the next call fail, once; so `write` tries twice.

    def read(self) -> bytes:
        with suppress(BlockingIOError, ConnectionRefusedError):
            return self._sock.recv(READ_BYTES)
        return b""

    def write(self, data: bytes) -> int:
        for _ in range(2):
            with suppress(ConnectionRefusedError):
                return super().write(data)
        return 0


class UdpInPort(Port):
    """A UDP socket that listens. It sends to the first sender, until `answer_sender` selects another."""

    def __init__(self, host: str, port: int) -> None:
        # No SO_REUSEADDR: with it, a second program on the port would silently take the first one's datagrams.
        super().__init__(_udp_socket(socket.socket.bind, host, port))
        self._peer: Sender | None = None
        self.connected = False

    def read(self) -> bytes:
        with suppress(BlockingIOError):
            data, self.sender = self._sock.recvfrom(READ_BYTES)
            if self._peer is None:
                self.answer_sender()
            return data
        return b""

    def write(self, data: bytes) -> int:
        with suppress(BlockingIOError):
            return self._sock.sendto(data, self._peer) if self._peer else 0
        return 0

    def answer_sender(self) -> None:
        self._peer, self.connected = self.sender, self.sender is not None


class TcpPort(Port):
    """A TCP connection to a server."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(socket.create_connection((host, port), CONNECT_TIMEOUT_S))
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, TCP_GIVE_UP_MS)
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, TCP_SEND_BYTES)
        if self._sock.getsockname() == self._sock.getpeername():
            # By chance, a connection to a local port without a listener can start from this same port.
            self.close()
            raise ConnectionRefusedError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))

    def unsent(self) -> int:
        # SIOCOUTQ, which has the number of TIOCOUTQ.
        return int.from_bytes(fcntl.ioctl(self._sock, termios.TIOCOUTQ, bytes(4)), "little")

    def throw_away(self) -> None:
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


class SerialPort(Port):
    """A serial line. It is read and written by its file descriptor, since pyserial's own non-blocking write spins when
    the buffer is full."""

    _end = "the device is gone"

    def __init__(self, device: str, baud: int) -> None:
        import serial  # not at the top: no other kind of link needs it

        if not stat.S_ISCHR(os.stat(device).st_mode):
            raise ValueError("it is no serial device")
        try:
            self._port = serial.Serial(device, baud, timeout=0, exclusive=True)
        except termios.error as error:  # not a subclass of OSError
            raise OSError(*error.args) from error
        except serial.SerialException as error:
            if isinstance(error.__context__, termios.error) and error.__context__.args[0] == errno.ENOTTY:
                raise ValueError("it is no serial device") from error
            raise

    def fileno(self) -> int:
        return int(self._port.fileno())

    def unsent(self) -> int:
        return int(self._port.out_waiting)

    def close(self) -> None:
        with suppress(OSError, termios.error):
            if self.unsent():
                # Bytes still in the buffer must neither leave later nor delay the close (for up to 30 s).
                self._port.reset_output_buffer()
        self._port.close()


_OPENERS: dict[str, Callable[[str, int], Port]] = {
    "udpout": UdpOutPort,
    "udpin": UdpInPort,
    "tcp": TcpPort,
    "serial": SerialPort,
}
_NOT_PERMITTED = "the system does not permit it: take a port above 1023 and the address of one host"
_NOT_OPENED = "this user may not open the device: add the user to the group that owns it (often `dialout`)"
_ADVICE = {  # by error, and whether the link is a serial one
    (errno.EADDRINUSE, False): "the port is in use by another program: stop that one, or take another port",
    (errno.EWOULDBLOCK, True): "the device is in use by another program: stop that one",
    (errno.EACCES, True): _NOT_OPENED,
    (errno.EPERM, True): _NOT_OPENED,
    (errno.EACCES, False): _NOT_PERMITTED,
    (errno.EPERM, False): _NOT_PERMITTED,
}


def open_port(address: LinkAddress) -> Port:
    """Open the port of a link.

    Raises LinkAddressError for an address that is wrong (an unknown host, a file that is no device, the address of a
    network), LinkError for another fault that the user must correct (a port in use, no permission), and OSError for a
    fault that may end by itself (a device that is not plugged in, a server that is not running).
    """
    is_serial = address.kind == "serial"
    try:
        return _OPENERS[address.kind](address.where, address.number)
    except (socket.gaierror, UnicodeError) as error:
        # The host may be found later: no name server has answered, or a .local host announces itself.
        is_unasked = isinstance(error, socket.gaierror) and error.errno != socket.EAI_NONAME
        kind = LinkError if is_unasked or address.where.endswith(".local") else LinkAddressError
        raise kind(f"{address}: there is no host {address.where!r}: correct it, or give an IP address.") from error
    except ValueError as error:
        raise LinkAddressError(
            f"{address}: it cannot be opened ({error}): correct the device or the baud rate."
        ) from error
    except OSError as error:
        if not (advice := _ADVICE.get((error.errno or 0, is_serial))):
            raise
        kind = LinkAddressError if error.errno == errno.EACCES and not is_serial else LinkError
        raise kind(f"{address}: {advice}.") from error


def _udp_socket(attach: Callable[[socket.socket, Sender], None], host: str, port: int) -> socket.socket:
    """Make a UDP socket, and attach it to `host` and `port` by `attach`: socket.bind or socket.connect."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        attach(sock, (host, port))
    except (OSError, UnicodeError):
        sock.close()
        raise
    return sock
