"""Reading the status of a flight from its socket."""

import json
import socket
import time
from contextlib import suppress
from pathlib import Path

from edgevpr.core.config import build
from edgevpr.core.errors import ConfigError, EdgevprError
from edgevpr.runtime.flight.status import Status

_PIECE_BYTES = 65_536
_MOST_BYTES = 1_000_000  # of a line; a status has some thousand


class StatusReader:
    """Reads the status of the flight at a socket, and of the next flight when that has ended. `trouble` is why there is
    none at the moment, in a few words; None while a flight is there."""

    def __init__(self, path: str | Path) -> None:
        self._path = path
        self._socket: socket.socket | None = None
        self._rest = b""
        self.trouble: str | None = "no flight has been looked for"

    def __enter__(self) -> "StatusReader":
        return self

    def __exit__(self, *_: object) -> None:
        self._let_go()

    def read(self, timeout_s: float) -> Status | None:
        """Return the newest status as soon as one has come; None where none has come within so many seconds.

        Raises EdgevprError where none will ever come: the socket may not be read, or tells something else.
        """
        give_up_s = time.monotonic() + timeout_s
        left_s = timeout_s
        while left_s > 0:
            if self._socket is None and not self._connect(left_s):
                time.sleep(left_s)  # as long as for a status: who asks in a loop does not turn idly
                return None
            if (line := self._line(left_s)) is not None:
                return self._status_of(line)
            left_s = give_up_s - time.monotonic()
        return None

    def _connect(self, timeout_s: float) -> bool:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connection.settimeout(timeout_s)
        try:
            connection.connect(str(self._path))
        except (FileNotFoundError, ConnectionRefusedError):  # the second: it was killed, and left its file
            self.trouble = f"no flight tells its status at {self._path}"
        except (BlockingIOError, TimeoutError):
            self.trouble = f"the flight at {self._path} does not answer: it is busy, or has too many readers"
        except OSError as error:
            connection.close()
            raise EdgevprError(
                f"The status at {self._path} cannot be read ({error.strerror or error}): be its user or of its group "
                "(sudo), or name another socket with --socket."
            ) from error
        else:
            self._socket, self._rest, self.trouble = connection, b"", None
            return True
        connection.close()
        return False

    def _line(self, timeout_s: float) -> bytes | None:
        """Return the newest line that is whole; None where there is none yet, or the flight has gone."""
        self._socket.settimeout(timeout_s)
        data = b""
        with suppress(ConnectionError):
            try:
                data = self._socket.recv(_PIECE_BYTES)
            except TimeoutError:
                return None
        if not data:
            self._let_go()
            self.trouble = f"the flight at {self._path} has ended"
            return None
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[:_MOST_BYTES]
        return lines[-1] if lines else None

    def _status_of(self, line: bytes) -> Status:
        try:
            fields = json.loads(line)
            if not isinstance(fields, dict):
                raise ValueError
            return build(Status, fields, str(self._path))
        except (ValueError, RecursionError, ConfigError) as error:
            raise EdgevprError(
                f"{self._path} tells no status that this edgevpr understands: use the edgevpr of the flight."
            ) from error

    def _let_go(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
