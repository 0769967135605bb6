"""Messages to systemd: starting, ready, alive, stopping, and a line of status. Without systemd nothing is sent.

The protocol is sd_notify(3): `KEY=value` lines in one datagram to the socket that $NOTIFY_SOCKET names.
"""

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from edgevpr.core.text import shown
from edgevpr.power.load import cpu_spent_s

_SEND_TIMEOUT_S = 0.5
_LOOK_S, _MORE_US = 20.0, 60_000_000
_WORKS = 0.05  # the share of a core below which a start waits for something and does not compute
_LONGEST_START_S = 1800.0


def notify(**assignments: object) -> bool:
    """Send the assignments (`READY=1`, `WATCHDOG=1`, `STOPPING=1`, `STATUS="12 places"`); True if they were sent.

    Never raises: a flight does not end because nobody listens.
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


def ready() -> None:
    """Tell that the start is over, and the flight begins."""
    notify(READY=1)


def stopping() -> None:
    """Tell that the flight ends."""
    notify(STOPPING=1)


def watchdog_ping() -> None:
    """Tell that the loop turns."""
    notify(WATCHDOG=1)


def status(text: str) -> None:
    """Tell how the flight goes, in one line."""
    notify(STATUS=text)


def watchdog_interval_s() -> float | None:
    """Return the seconds after which `watchdog_ping` is due again, None where no watchdog waits for this process.

    It is half the unit's WatchdogSec, as sd_watchdog_enabled(3) advises.
    """
    try:
        watched = int(os.environ.get("WATCHDOG_PID", os.getpid())) == os.getpid()
        timeout_us = int(os.environ["WATCHDOG_USEC"])
    except (KeyError, ValueError):
        return None
    return timeout_us / 2e6 if watched and timeout_us > 0 else None


@contextmanager
def more_time_to_start(
    look_s: float = _LOOK_S, spent_s: Callable[[], float] = cpu_spent_s, longest_s: float = _LONGEST_START_S
) -> Iterator[None]:
    """Ask systemd for more time, inside this context, for as long as this process or one that it has started computes:
    to try a technique, or to load a map, takes minutes on a slow board, and a start that is broken off begins again at
    nothing.

    A start that hangs gets one minute and no more, and none gets more than `longest_s`. `spent_s` gives the CPU time
    spent so far, which is looked at every `look_s` seconds.
    """
    begun = threading.Event()

    def ask() -> None:
        before_s, until_s = spent_s(), time.monotonic() + longest_s
        while not begun.wait(look_s) and time.monotonic() < until_s:
            now_s = spent_s()
            if now_s - before_s >= _WORKS * look_s:
                notify(EXTEND_TIMEOUT_USEC=_MORE_US)
            before_s = now_s

    if "NOTIFY_SOCKET" not in os.environ:
        yield
        return
    if longest_s > 0:
        notify(EXTEND_TIMEOUT_USEC=_MORE_US)  # at once: to get here took imports, on a slow board half a minute
    thread = threading.Thread(target=ask, name="start", daemon=True)
    thread.start()
    try:
        yield
    finally:
        begun.set()
        thread.join()
