"""A link to an autopilot that is worked by hand, by a clock that stands unless it is turned."""

import pytest
from fakes import FakeClock
from mavlink_peers import Peer, UdpPort, make_link
from scripted_autopilot import Autopilot


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def port():
    port = UdpPort()
    yield port
    port.close()


@pytest.fixture
def link(port, clock):
    with make_link(f"udpout:127.0.0.1:{port.number}", clock=clock) as link:
        yield link


@pytest.fixture
def peer(port, link):
    """The other end, system 7, which has not spoken yet."""
    peer = Peer(port, system_id=7)
    peer.expect("HEARTBEAT")
    return peer


@pytest.fixture
def autopilot():
    """An autopilot in a conversation without a port."""
    return Autopilot()
