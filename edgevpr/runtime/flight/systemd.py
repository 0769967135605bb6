"""Messages to systemd: starting, ready, alive, stopping, and a line of status. Without systemd nothing is sent.
`flight` and `vitals` use it.

The protocol is sd_notify(3): `KEY=value` lines in one datagram to the socket that $NOTIFY_SOCKET names.
"""

import os
import socket

from edgevpr.core.text import shown

_SEND_TIMEOUT_S = 0.5
_LONGEST_START_US = 1_800_000_000


def notify(**assignments: object) -> bool:
    """Send assignments, such as READY=1, WATCHDOG=1 or STATUS="12 places". Returns True if they were sent.

    Never raises: a flight must not end because nobody listens.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    if address[0] == "@":  # a name in the abstract namespace, which begins with a zero byte
        address = "\0" + address[1:]
    # A line break in a value would begin an assignment of its own.
    lines = (f"{key}={shown(' '.join(str(value).splitlines()))}" for key, value in assignments.items())
    message = "\n".join(lines).encode("utf-8")
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            sender.settimeout(_SEND_TIMEOUT_S)  # the receiver's queue may be full; the main loop must not hang on it
            sender.sendto(message, address)
    except OSError:
        return False
    return True


def starting() -> None:
    """Ask for half an hour to start in: measuring a technique or loading a map takes minutes on a slow board, and if
    systemd stopped that, it would start again from nothing."""
    notify(EXTEND_TIMEOUT_USEC=_LONGEST_START_US)


def ready() -> None:
    """Report that the start is over and the flight begins."""
    notify(READY=1)


def stopping() -> None:
    """Report that the flight ends."""
    notify(STOPPING=1)


def watchdog_ping() -> None:
    """Report that the loop of the flight still runs."""
    notify(WATCHDOG=1)


def status(text: str) -> None:
    """Send one line on how the flight goes."""
    notify(STATUS=text)


def watchdog_interval_s() -> float | None:
    """Return the seconds between two calls of `watchdog_ping`; None if systemd does not watch this process.

    It is half the unit's WatchdogSec, as sd_watchdog_enabled(3) advises.
    """
    try:
        watched = int(os.environ.get("WATCHDOG_PID", os.getpid())) == os.getpid()
        timeout_us = int(os.environ["WATCHDOG_USEC"])
    except (KeyError, ValueError):
        return None
    return timeout_us / 2e6 if watched and timeout_us > 0 else None
