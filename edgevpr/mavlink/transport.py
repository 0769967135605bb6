"""The interface that a link needs of a port of any kind, and the function that opens one.

A lost transport raises OSError from `read` or `write`; its owner closes it and opens another.
"""

import errno
import socket
from typing import Protocol

from edgevpr.core.errors import LinkAddressError, LinkError
from edgevpr.mavlink.address import LinkAddress, Sender
from edgevpr.mavlink.ports import SerialPort, TcpPort, UdpInPort, UdpOutPort


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

    @property
    def sender(self) -> Sender | None:
        """Sender of the last bytes read; None where there can be only one."""
        ...

    def answer_sender(self) -> None:
        """Send from this call on to the sender of the last bytes (where there can be several senders)."""
        ...

    def unsent(self) -> int:
        """Return the number of bytes taken that have not left the system yet, or are not confirmed (TCP)."""
        ...

    def throw_away(self) -> None:
        """Let `close` throw away the bytes that have not left, instead of sending them later."""
        ...

    def close(self) -> None: ...


def open_transport(address: LinkAddress) -> Transport:
    """Open the transport of a link.

    Raises LinkAddressError for an address that is wrong (an unknown host, a file that is no device, the address of a
    network), LinkError for another fault that the user must correct (a port in use, no permission), and OSError for a
    fault that may end by itself (a device that is not plugged in, a server that is not running).
    """
    try:
        return _OPENERS[address.kind](address.where, address.number)
    except (socket.gaierror, UnicodeError) as error:
        kind = LinkError if _may_appear(address, error) else LinkAddressError
        raise kind(f"{address}: there is no host {address.where!r}: correct it, or give an IP address.") from error
    except ValueError as error:
        raise LinkAddressError(
            f"{address}: it cannot be opened ({error}): correct the device or the baud rate."
        ) from error
    except OSError as error:
        advice = _advice(address, error.errno)
        if advice is None:
            raise
        is_wrong = error.errno == errno.EACCES and address.kind != "serial"
        raise (LinkAddressError if is_wrong else LinkError)(f"{address}: {advice}.") from error


def _may_appear(address: LinkAddress, error: Exception) -> bool:
    """Tell whether a host that is not found may be found later: no name server answers, or it announces itself."""
    is_unasked = isinstance(error, socket.gaierror) and error.errno != socket.EAI_NONAME
    return is_unasked or address.where.endswith(".local")


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


_OPENERS = {"udpout": UdpOutPort, "udpin": UdpInPort, "tcp": TcpPort, "serial": SerialPort}
