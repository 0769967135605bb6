"""Four transports of bytes, none of which ever blocks once it is open: UDP out and in, TCP, serial.

A lost transport raises OSError from `read` or `write`; its owner closes it and opens another. This thin layer over
`socket` and pyserial behaves the same in every fault. pymavlink's own connections may spin, hang or raise.
"""

import errno
import os
import socket
import stat
import termios
from contextlib import suppress
from typing import Protocol

from edgevpr.errors import LinkError
from edgevpr.mavlink.address import LinkAddress

CONNECT_TIMEOUT_S = 1.0
TCP_GIVE_UP_MS = 1000  # if the other end has not confirmed bytes by then, the connection is closed and they are lost
READ_BYTES = 65_536


class Transport(Protocol):
    """The interface that a link needs of a transport."""

    @property
    def connected(self) -> bool:
        """True where there is a receiver to send to."""
        ...

    def fileno(self) -> int: ...

    def read(self) -> bytes:
        """Return the bytes that have arrived, b"" for none; raises OSError where the connection is lost."""
        ...

    def write(self, data: bytes) -> int:
        """Take as many bytes as fit at once and return their number; raises OSError where the connection is lost."""
        ...

    def answer_sender(self) -> None:
        """Send from this call on to the sender of the last bytes (where there can be several senders)."""
        ...

    def idle(self) -> bool:
        """Tell whether all bytes taken have left, or will be sent by the system."""
        ...

    def close(self) -> None: ...


def open_transport(address: LinkAddress) -> Transport:
    """Open the transport of a link.

    Raises LinkError for a fault that the user must correct (an unknown host, a port in use, no permission), and OSError
    for a fault that may end by itself (a device that is not plugged in, a server that is not running).
    """
    try:
        return _OPENERS[address.kind](address.where, address.number)
    except (socket.gaierror, UnicodeError) as error:
        raise LinkError(f"{address}: there is no host {address.where!r}: correct it, or give an IP address.") from error
    except ValueError as error:
        raise LinkError(f"{address}: it cannot be opened ({error}): correct the device or the baud rate.") from error
    except OSError as error:
        advice = _advice(address, error.errno)
        if advice is None:
            raise
        raise LinkError(f"{address}: {advice}.") from error


def _advice(address: LinkAddress, number: int | None) -> str | None:
    match number, address.kind:
        case (errno.EADDRINUSE, _):
            return f"port {address.number} is in use by another program: stop that one, or take another port"
        case (errno.EWOULDBLOCK, "serial"):
            return "the device is in use by another program: stop that one"
        case (errno.EACCES | errno.EPERM, "serial"):
            return "this user may not open the device: add the user to the group that owns it (often `dialout`)"
        case (errno.EACCES | errno.EPERM, _):
            return "the system does not permit it: take a port above 1023 and the address of one host"
    return None


class _Socket:
    connected = True

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._sock = sock

    def fileno(self) -> int:
        return self._sock.fileno()

    def answer_sender(self) -> None:
        pass

    def idle(self) -> bool:
        return True

    def close(self) -> None:
        self._sock.close()


class _Udp(_Socket):
    """A UDP socket that sends to the given peer. Without one, it sends to the first sender heard, until `answer_sender`
    selects another."""

    def __init__(self, own: tuple[str, int], peer: tuple[str, int] | None) -> None:
        super().__init__(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self._given_host = peer and peer[0]
        self._peer = self._sender = peer
        try:
            # No SO_REUSEADDR: with it, a second program on the port would silently take the first one's datagrams.
            self._sock.bind(own)
        except OSError:
            self.close()
            raise

    @property
    def connected(self) -> bool:  # type: ignore[override]
        return self._peer is not None

    def read(self) -> bytes:
        with suppress(BlockingIOError):
            data, sender = self._sock.recvfrom(READ_BYTES)
            if self._given_host in (None, sender[0]):  # the host, not the port: a peer may answer from another
                self._sender = sender
                self._peer = self._peer or sender
                return data
        return b""

    def write(self, data: bytes) -> int:
        with suppress(BlockingIOError):
            return self._sock.sendto(data, self._peer)  # type: ignore[arg-type]
        return 0

    def answer_sender(self) -> None:
        if self._given_host is None:
            self._peer = self._sender


class _Tcp(_Socket):
    def __init__(self, host: str, port: int) -> None:
        super().__init__(socket.create_connection((host, port), CONNECT_TIMEOUT_S))
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, TCP_GIVE_UP_MS)
        if self._sock.getsockname() == self._sock.getpeername():
            # A connection to a local port without a listener can, by chance, start from this same port: a socket that
            # is connected to itself.
            self.close()
            raise ConnectionRefusedError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))

    def read(self) -> bytes:
        with suppress(BlockingIOError):
            data = self._sock.recv(READ_BYTES)
            if not data:
                raise ConnectionError("the other end closed the connection")
            return data
        return b""

    def write(self, data: bytes) -> int:
        with suppress(BlockingIOError):
            return self._sock.send(data)
        return 0


class _Serial:
    connected = True

    def __init__(self, device: str, baud: int) -> None:
        import serial  # not at the top: no other kind of link needs it

        if not stat.S_ISCHR(os.stat(device).st_mode):
            raise ValueError("it is no serial device")
        try:
            self._port = serial.Serial(device, baud, timeout=0, exclusive=True)
        except termios.error as error:  # not a subclass of OSError
            raise OSError(*error.args) from error

    def fileno(self) -> int:
        return self._port.fileno()

    # Not pyserial's own `read` and `write`: when the buffer is full, its non-blocking write spins.

    def read(self) -> bytes:
        with suppress(BlockingIOError):
            data = os.read(self._port.fd, READ_BYTES)
            if not data:
                raise ConnectionError("the device is gone")
            return data
        return b""

    def write(self, data: bytes) -> int:
        with suppress(BlockingIOError):
            return os.write(self._port.fd, data)
        return 0

    def answer_sender(self) -> None:
        pass

    def idle(self) -> bool:
        return self._port.out_waiting == 0

    def close(self) -> None:
        with suppress(OSError, termios.error):
            if not self.idle():
                # Bytes that the line has not taken must neither leave later nor delay the close (for up to 30 s).
                self._port.reset_output_buffer()
        self._port.close()


def _udp_out(host: str, port: int) -> Transport:
    return _Udp(("", 0), peer=_resolved(host, port))


def _udp_in(host: str, port: int) -> Transport:
    return _Udp(_resolved(host, port), peer=None)


def _resolved(host: str, port: int) -> tuple[str, int]:
    return socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4]  # type: ignore[return-value]


_OPENERS = {"udpout": _udp_out, "udpin": _udp_in, "tcp": _Tcp, "serial": _Serial}
