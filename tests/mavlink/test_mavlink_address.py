import os
import re
import socket

import pytest

from edgevpr.core.errors import LinkAddressError, LinkError
from edgevpr.mavlink.address import LinkAddress, parse_link
from edgevpr.mavlink.ports import open_port


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("udpout:192.168.1.10:14550", LinkAddress("udpout", "192.168.1.10", 14550)),
        ("udpin:0.0.0.0:14550", LinkAddress("udpin", "0.0.0.0", 14550)),
        ("tcp:localhost:5760", LinkAddress("tcp", "localhost", 5760)),
        ("serial:/dev/ttyAMA0:921600", LinkAddress("serial", "/dev/ttyAMA0", 921600)),
        (
            "serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0:57600",
            LinkAddress("serial", "/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0", 57600),
        ),
    ],
)
def test_parse_link_reverses_str(url, address):
    assert parse_link(url) == address
    assert str(address) == url


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("", "use udpout:HOST:PORT"),
        ("udp:127.0.0.1:14550", "use udpout:HOST:PORT"),
        ("udpout:127.0.0.1", "use udpout:HOST:PORT"),
        ("udpin::14550", "use udpout:HOST:PORT"),
        ("/dev/ttyACM0", "use udpout:HOST:PORT"),
        ("udpout:127.0.0.1:port", "'port'"),
        ("udpout:127.0.0.1:0", "from 1 to 65535"),
        ("udpout:127.0.0.1:65536", "from 1 to 65535"),
        ("udpout:127.0.0.1:" + "9" * 5000, "from 1 to 65535"),
        ("tcp:::1:5760", "IPv4"),
        ("serial:/dev/ttyACM0:fast", "57600"),
        ("serial:/dev/ttyACM0:0", "57600"),
    ],
)
def test_parse_link_refuses_a_malformed_link_in_one_sentence(url, says):
    with pytest.raises(LinkAddressError, match=re.escape(says)):
        parse_link(url)


@pytest.mark.parametrize(
    "link",
    [
        "udpout:127.0.0.l:14550",
        "udpout:255.255.255.255:14550",
        "tcp:a..b:5760",
        "serial:/etc/hostname:57600",
        "serial:/dev/null:57600",
    ],
)
def test_open_port_treats_an_invalid_address_as_a_usage_error(link):
    before = os.listdir("/proc/self/fd")
    with pytest.raises(LinkAddressError) as caught:
        open_port(parse_link(link))
    assert caught.value.exit_code == 2
    assert os.listdir("/proc/self/fd") == before, "it is closed"


def test_open_port_treats_a_passing_fault_as_a_link_error():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        before = os.listdir("/proc/self/fd")
        with pytest.raises(LinkError) as caught:
            open_port(parse_link(f"udpin:127.0.0.1:{other.getsockname()[1]}"))
        assert caught.value.exit_code == 1
        assert os.listdir("/proc/self/fd") == before, "it is closed"
    with pytest.raises(LinkError) as caught:
        open_port(parse_link("tcp:no-such-drone.local:5760"))
    assert caught.value.exit_code == 1, "a host that announces itself may not be up yet"
