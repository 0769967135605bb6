"""Messages to systemd (sd_notify(3)): `KEY=value` lines in one datagram to $NOTIFY_SOCKET, if that is set."""

import os
import socket
from contextlib import suppress

from edgevpr.core.text import sanitize

# Requested at startup: loading a map takes minutes on a slow board.
MAX_START_US = 1_800_000_000
_SEND_TIMEOUT_S = 0.5


def is_service() -> bool:
    """Return True if systemd has started this process as a service that reports to it."""
    return "NOTIFY_SOCKET" in os.environ


def notify(**assignments: object) -> None:
    """Send assignments, such as READY=1 or STATUS="12 places". Never raises, even if nothing reads them."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    if address[0] == "@":  # a name in the abstract namespace begins with a zero byte
        address = "\0" + address[1:]
    # A line break in a value would start another assignment.
    lines = (f"{key}={sanitize(' '.join(str(value).splitlines()))}" for key, value in assignments.items())
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.settimeout(_SEND_TIMEOUT_S)  # the receiver's queue may be full; the main loop must not hang on it
        sender.sendto("\n".join(lines).encode("utf-8"), address)


def watchdog_interval_s() -> float | None:
    """Return the seconds between two WATCHDOG messages, half the unit's WatchdogSec (sd_watchdog_enabled(3)); None if
    systemd does not watch this process."""
    try:
        watched = int(os.environ.get("WATCHDOG_PID", os.getpid())) == os.getpid()
        timeout_us = int(os.environ["WATCHDOG_USEC"])
    except (KeyError, ValueError):
        return None
    return timeout_us / 2e6 if watched and timeout_us > 0 else None
