"""The link of a flight is opened as the configuration says."""

import time
from contextlib import ExitStack, closing
from dataclasses import replace
from types import SimpleNamespace

import pytest
from loopback import wait_until
from mavlink_peers import Peer, UdpPort

from edgevpr.core.config import load_config
from edgevpr.core.errors import ConfigError
from edgevpr.mavlink.driver import PortDriver
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.signing import NOT_SIGNING, open_signing
from edgevpr.mavlink.turns import Turns
from edgevpr.runtime.flight.flight import open_links
from edgevpr.runtime.flight.navigator import Navigator


def opened(config, port, signing, stack):
    settings = replace(config.mavlink, link=f"udpout:127.0.0.1:{port.number}")
    world = SimpleNamespace(turns=Turns(time.monotonic), drive=PortDriver, signing=signing)
    return open_links(settings, world, Navigator(5.0, 1.0), None, stack)[0]


def test_open_links_uses_the_keys_of_the_configuration():
    keys = {"mavlink.system_id": 5, "mavlink.component_id": 191, "mavlink.max_fix_age_s": 0.2}
    config = load_config(None, keys)
    with ExitStack() as stack:
        port = stack.enter_context(closing(UdpPort()))
        link = opened(config, port, NOT_SIGNING, stack)
        heartbeat = Peer(port).expect("HEARTBEAT")
        assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (5, 191)
        sending = link.send_fix(Fix(50.0, 8.0, 20.0, link.turns.now_s()))
        wait_until(lambda: sending.sent is not None)
        assert sending.why.parameters["limit_s"] == 0.2


def test_open_links_signs_and_keeps_the_time(tmp_path):
    key, state = tmp_path / "key", tmp_path / "state"
    key.write_bytes(bytes(32))
    key.chmod(0o600)
    config = load_config(None, {"mavlink.signing_key": str(key), "mavlink.signing_state": str(state)})
    with ExitStack() as stack:
        port = stack.enter_context(closing(UdpPort()))
        signing = open_signing(config.mavlink.signing_key, config.mavlink.signing_state)
        opened(config, port, signing, stack)
        assert Peer(port).expect("HEARTBEAT").get_header().incompat_flags == 1  # signed
    assert state.exists()
    key.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        open_signing(config.mavlink.signing_key, config.mavlink.signing_state)
