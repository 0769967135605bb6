"""The local socket at which a flight tells its status, one JSON object a line, once a second."""

import errno
import os
import socket
import stat
from contextlib import suppress
from pathlib import Path

from edgevpr.core.errors import EdgevprError
from edgevpr.core.text import json_line
from edgevpr.runtime.flight.status import Status

NAME = "status.sock"
_MODE = 0o660  # positions are nobody else's, and the group of the flight may look on
_MOST_READERS = 32  # at once: descriptors are for the camera and the link; others wait until one has gone
_WAITING_BYTES = 32_768  # for each reader, of the flight's memory


class StatusSocket:
    """A socket in the file system that tells the status to whoever connects. Close it (it is a context manager), which
    removes the file.

    A file of that name that a killed flight has left is replaced. It never waits: a reader that has gone, or does not
    take its line as a whole, is let go.
    """

    def __init__(self, path: str | Path) -> None:
        """Open the socket. Raises EdgevprError where it cannot be opened, or another flight has it."""
        self._path = Path(path)
        self._readers: list[socket.socket] = []
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.setblocking(False)
        try:
            self._bind()
        except OSError as error:
            self._listener.close()
            raise EdgevprError(
                f"The status socket {path} cannot be made ({error.strerror or error}): give a short name in a folder "
                "that is there and may be written to, or none (status.socket)."
            ) from error
        except EdgevprError:
            self._listener.close()
            raise

    def __enter__(self) -> "StatusSocket":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def tell(self, status: Status) -> None:
        """Tell all readers the status. It never blocks and never raises OSError."""
        self._accept()
        if not self._readers:
            return
        line = json_line(status)
        for reader in tuple(self._readers):
            try:
                taken = reader.send(line)
            except OSError:  # it has gone, or has not read for long
                taken = 0
            if taken != len(line):
                self._readers.remove(reader)
                reader.close()

    def close(self) -> None:
        """Let all readers go, and remove the file."""
        for each in (self._listener, *self._readers):
            each.close()
        self._readers.clear()
        with suppress(OSError):
            if os.path.samestat(os.lstat(self._path), self._stat):  # not that of another flight
                os.unlink(self._path)

    def _bind(self) -> None:
        os.fchmod(self._listener.fileno(), _MODE)  # before there is a file: it is open to others at no time
        try:
            self._listener.bind(str(self._path))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            _remove_stale(self._path)
            self._listener.bind(str(self._path))
        os.chmod(self._path, _MODE)  # of which the umask has taken away
        self._stat = os.lstat(self._path)
        self._listener.listen()

    def _accept(self) -> None:
        with suppress(OSError):  # there is no more, or there are too many files open
            while len(self._readers) < _MOST_READERS:
                reader, _ = self._listener.accept()
                reader.setblocking(False)
                reader.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _WAITING_BYTES)
                self._readers.append(reader)


def usual_path() -> str | None:
    """Return the path in the folder that systemd has made for a service, None where it has made none."""
    folder = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    return str(Path(folder) / NAME) if folder else None


def _remove_stale(path: Path) -> None:
    if not stat.S_ISSOCK(os.lstat(path).st_mode):
        raise EdgevprError(f"{path} is there and is no socket: give the status socket another name (status.socket).")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            os.unlink(path)
            return
        except BlockingIOError:  # somebody is there, and has many readers waiting
            pass
    raise EdgevprError(
        f"Another flight tells its status at {path}: end it, or give this one a socket of its own (status.socket)."
    )
