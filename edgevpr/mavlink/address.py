"""Addresses of MAVLink links, parsed from the setting `mavlink.link`."""

from dataclasses import dataclass

from edgevpr.core.errors import LinkAddressError

FORMS = "udpout:HOST:PORT, udpin:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"
_BAUD = 1200, 12_000_000, "the baud rate must be a number such as 57600 or 921600"
_PORT = 1, 65_535, "the port must be a whole number from 1 to 65535"

Sender = tuple[str, int]  # host and port


@dataclass(frozen=True, slots=True)
class LinkAddress:
    """The parsed address of a link. `target`: a host (for udpin: the local address to listen on) or the path of a
    serial device. `number`: a UDP or TCP port, or the baud rate of the serial device."""

    kind: str  # "udpout", "udpin", "tcp" or "serial"
    target: str
    number: int

    def __str__(self) -> str:
        return f"{self.kind}:{self.target}:{self.number}"


def parse_link(url: str) -> LinkAddress:
    """Parse an address, such as `udpout:127.0.0.1:14550`. Raises LinkAddressError if it has none of the FORMS."""
    kind, _, remainder = url.partition(":")
    target, _, number = remainder.rpartition(":")  # from the right: names in /dev/serial/by-path contain colons
    if kind not in ("udpout", "udpin", "tcp", "serial") or not target.strip() or not number:
        raise LinkAddressError(f"{url!r} is not a MAVLink address: use {FORMS}.")
    if kind != "serial" and ":" in target:
        raise LinkAddressError(f"{url}: {target!r} must be a host name or an IPv4 address.")
    low, high, rule = _BAUD if kind == "serial" else _PORT
    if not (number.isascii() and number.isdigit() and len(number) < 10 and low <= int(number) <= high):
        raise LinkAddressError(f"{url}: {rule}, not {number!r}.")
    return LinkAddress(kind, target, int(number))
