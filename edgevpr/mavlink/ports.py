"""Four kinds of port, none of which ever blocks once it is open: UDP out and in, TCP, serial.

This thin layer over `socket` and pyserial behaves the same in every fault. pymavlink's own connections may spin, hang
or raise. `transport.Transport` says what each method does.
"""

import errno
import fcntl
import os
import socket
import stat
import struct
import termios
from contextlib import suppress

from edgevpr.mavlink.address import Sender

CONNECT_TIMEOUT_S = 1.0
TCP_GIVE_UP_MS = 1000  # if the other end has not confirmed bytes by then, the connection is closed and they are lost
TCP_SEND_BYTES = 8192  # doubled by the system: some 30 messages; left to itself it takes megabytes
READ_BYTES = 65_536


class _Socket:
    connected = True
    sender: Sender | None = None

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._sock = sock

    def fileno(self) -> int:
        return self._sock.fileno()

    def answer_sender(self) -> None:
        pass

    def unsent(self) -> int:
        return 0

    def throw_away(self) -> None:
        pass

    def close(self) -> None:
        self._sock.close()


class UdpOutPort(_Socket):
    """A UDP socket that is connected to one peer: the system drops what comes from any other address."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        try:
            self._sock.connect(_resolved(host, port))
        except OSError:
            self.close()
            raise

    # A datagram that nobody took makes the next call fail, once.

    def read(self) -> bytes:
        with suppress(BlockingIOError, ConnectionRefusedError):
            return self._sock.recv(READ_BYTES)
        return b""

    def write(self, data: bytes) -> int:
        for _ in range(2):
            with suppress(BlockingIOError, ConnectionRefusedError):
                return self._sock.send(data)
        return 0


class UdpInPort(_Socket):
    """A UDP socket that listens. It sends to the first sender heard, until `answer_sender` selects another."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self._peer: Sender | None = None
        try:
            # No SO_REUSEADDR: with it, a second program on the port would silently take the first one's datagrams.
            self._sock.bind(_resolved(host, port))
        except OSError:
            self.close()
            raise

    @property
    def connected(self) -> bool:  # type: ignore[override]
        return self._peer is not None

    def read(self) -> bytes:
        with suppress(BlockingIOError):
            data, self.sender = self._sock.recvfrom(READ_BYTES)
            self._peer = self._peer or self.sender
            return data
        return b""

    def write(self, data: bytes) -> int:
        with suppress(BlockingIOError):
            return self._sock.sendto(data, self._peer)  # type: ignore[arg-type]
        return 0

    def answer_sender(self) -> None:
        self._peer = self.sender


class TcpPort(_Socket):
    def __init__(self, host: str, port: int) -> None:
        super().__init__(socket.create_connection((host, port), CONNECT_TIMEOUT_S))
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, TCP_GIVE_UP_MS)
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, TCP_SEND_BYTES)
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

    def unsent(self) -> int:
        # SIOCOUTQ, which has the number of TIOCOUTQ.
        return struct.unpack("i", fcntl.ioctl(self._sock, termios.TIOCOUTQ, bytes(4)))[0]

    def throw_away(self) -> None:
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


class SerialPort:
    connected = True
    sender: Sender | None = None

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

    def unsent(self) -> int:
        return self._port.out_waiting

    def throw_away(self) -> None:
        pass

    def close(self) -> None:
        with suppress(OSError, termios.error):
            if self.unsent():
                # Bytes that the line has not taken must neither leave later nor delay the close (for up to 30 s).
                self._port.reset_output_buffer()
        self._port.close()


def _resolved(host: str, port: int) -> Sender:
    return socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4]  # type: ignore[return-value]
