"""The telemetry log (tlog): a file of every packet of a link, which ground stations and pymavlink's mavlogdump read."""

import errno
import logging
import os
import struct
import threading
import time
from collections import deque
from contextlib import AbstractContextManager
from pathlib import Path

from edgevpr.core.appending import append, keep_within, open_appending, set_aside, sync
from edgevpr.core.errors import EdgevprError

MOST_BYTES = 256_000_000  # of one file, days of a usual link; with the one before it there are at most twice as many
SPARED_BYTES = 20_000_000  # of the disk, which are left to the flight log
WAITING_MAX = 4096  # packets that a slow disk keeps waiting: half a minute or more of a usual link
WRITE_S = 1.0
CLOSE_S = 2.0

_log = logging.getLogger(__name__)


class Tlog(AbstractContextManager["Tlog"]):
    """An open tlog, a context manager. For each packet it holds the microseconds since 1970 (8 bytes, big endian), then
    the packet. An existing file is appended to. A thread of its own writes once a second, so that no caller waits. A
    disk that is full or too slow ends the log, but not the flight."""

    def __init__(self, path: str | Path) -> None:
        """Open the file. Raises EdgevprError if it cannot be opened."""
        self._path = Path(os.path.realpath(path))
        self._waiting: deque[bytes] = deque()  # time stamps with their packets
        self._closing, self._ended = threading.Event(), False
        try:
            self._file = open_appending(self._path)
        except OSError as error:
            why = f"The tlog {path} cannot be opened ({error.strerror})"
            raise EdgevprError(f"{why}: give a file in a folder that is there and may be written to.") from error
        self._thread = threading.Thread(target=self._run, name="tlog", daemon=True)
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def record(self, packet: bytes) -> None:
        """Queue a packet to be written. Any thread may call this; it never blocks and never raises."""
        stamp = struct.pack(">Q", time.time_ns() // 1000 & ~3)  # the last two bits would be the number of a link
        if not self._ended and len(self._waiting) < WAITING_MAX:
            self._waiting.append(stamp + packet)

    def close(self) -> None:
        """Write the queued packets, for two seconds at most, and close the file."""
        self._closing.set()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            _log.warning("The end of the tlog %s may be missing: the disk is too slow.", self._path)

    # The methods below run in the log's own thread.

    def _run(self) -> None:
        try:
            while not self._closing.wait(WRITE_S):
                self._write()
            self._write()
        except OSError as error:
            why = f"{self._path} has ended ({error.strerror})"
            _log.warning("The tlog %s: make room for the next flight; this one goes on without it.", why)
        finally:
            self._ended = True
            self._waiting.clear()
            self._file.close()

    def _write(self) -> None:
        if len(self._waiting) == WAITING_MAX:
            raise OSError(errno.EIO, "the disk is too slow for it")
        records = b"".join(self._waiting.popleft() for _ in range(len(self._waiting)))
        if not records:
            return
        if os.fstat(self._file.fileno()).st_size + len(records) > MOST_BYTES:
            set_aside(self._path)
            keep_within(self._path, MOST_BYTES)
            self._file.close()
            self._file = open_appending(self._path)
        disk = os.fstatvfs(self._file.fileno())
        if disk.f_bavail * disk.f_frsize < SPARED_BYTES:
            raise OSError(errno.ENOSPC, f"less than {SPARED_BYTES // 1_000_000} MB are left on the disk")
        append(self._file, records)
        sync(self._file)
