"""The link of a flight is opened as the configuration says; how it signs is shown by a replay."""

import time
from contextlib import ExitStack, closing
from dataclasses import replace
from types import SimpleNamespace

from loopback import wait_until
from mavlink_peers import Peer, UdpPort

from edgevpr.core.config import load_config
from edgevpr.mavlink.driver import PortDriver
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.signing import NOT_SIGNING
from edgevpr.mavlink.turns import Turns
from edgevpr.runtime.flight.flight import open_link
from edgevpr.runtime.flight.navigator import Navigator


def test_open_link_uses_the_keys_of_the_configuration():
    config = load_config(None, {"mavlink.system_id": 5, "mavlink.component_id": 191, "mavlink.max_fix_age_s": 0.2})
    world = SimpleNamespace(turns=Turns(time.monotonic), drive=PortDriver, signing=NOT_SIGNING)
    with ExitStack() as stack:
        port = stack.enter_context(closing(UdpPort()))
        settings = replace(config.mavlink, link=f"udpout:127.0.0.1:{port.number}")
        link = open_link(settings, world, Navigator(5.0, 1.0), None, stack)
        heartbeat = Peer(port).expect("HEARTBEAT")
        assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (5, 191)
        sending = link.send_fix(Fix(50.0, 8.0, 20.0, link.turns.now_s()))
        wait_until(lambda: sending.sent is not None)
        assert sending.why.parameters["limit_s"] == 0.2
