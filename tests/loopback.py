"""What tests of streams and of links share on this machine's loopback: patience, and ports that are free."""

import socket
import time
from contextlib import suppress

PATIENCE_S = 60.0  # a machine that does much else is slow, and not wrong


def wait_until(condition, what: str = "the condition", every_s: float = 0.005):
    """Wait for something that happens at once on a quiet machine; returns what `condition` gave."""
    give_up_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < give_up_s:
        if result := condition():
            return result
        time.sleep(every_s)
    raise AssertionError(f"{what} did not come true in {PATIENCE_S:.0f} s")


def free_port() -> int:
    """A port that was free a moment ago, for TCP and for UDP."""
    while True:
        with suppress(OSError), socket.socket() as tcp, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            tcp.bind(("127.0.0.1", 0))
            udp.bind(tcp.getsockname())
            return udp.getsockname()[1]
