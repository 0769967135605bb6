import pytest

from edgevpr.errors import LinkError
from edgevpr.mavlink.address import LinkAddress, parse_link


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
def test_a_link_is_read_and_written_alike(url, address):
    assert parse_link(url) == address
    assert str(address) == url


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("", "write udpout:HOST:PORT"),
        ("udp:127.0.0.1:14550", "write udpout:HOST:PORT"),
        ("udpout", "write udpout:HOST:PORT"),
        ("udpout:127.0.0.1", "write udpout:HOST:PORT"),
        ("udpin::14550", "write udpout:HOST:PORT"),
        ("udpin:14550:", "write udpout:HOST:PORT"),
        ("/dev/ttyACM0", "write udpout:HOST:PORT"),
        ("udpout:127.0.0.1:port", "'port'"),
        ("udpout:127.0.0.1:0", "from 1 to 65535"),
        ("udpout:127.0.0.1:65536", "from 1 to 65535"),
        ("udpout:127.0.0.1:-1", "from 1 to 65535"),
        ("udpout:127.0.0.1:" + "9" * 5000, "from 1 to 65535"),
        ("tcp:::1:5760", "IPv4"),
        ("serial:/dev/ttyACM0:fast", "57600"),
        ("serial:/dev/ttyACM0:0", "57600"),
    ],
)
def test_a_malformed_link_gets_one_sentence(url, says):
    with pytest.raises(LinkError) as caught:
        parse_link(url)
    assert says in str(caught.value)
    assert str(caught.value).endswith(".")
