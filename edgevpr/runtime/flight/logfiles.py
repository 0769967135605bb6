"""The files of a flight log: the one that is written, and those with numbers, the oldest of which are deleted."""

import logging
import math
import os
import stat
from pathlib import Path
from typing import BinaryIO

from edgevpr.core.appending import claim, keep_within, open_appending, set_aside, try_lock

_PARTS = 4  # of `max_mb`: the file that is written, and three for those that are set aside

_log = logging.getLogger(__name__)


class LogFiles:
    """The files of the log `path`. `at` is the file to be written: `path`, or one with a number (`helpers.numbered`)
    where another process writes `path`.

    All of them together have at most `max_mb`, and the one that is written a quarter of that (None: without limit, and
    nothing is deleted).
    """

    def __init__(self, path: str | Path, max_mb: float | None) -> None:
        self.at, self._path = Path(path), Path(path)
        self.part_bytes = math.inf if max_mb is None else 1e6 * max_mb / _PARTS
        self._said: set[str] = set()

    def open(self) -> BinaryIO:
        """Open the file to be written, which is then locked. Raises OSError."""
        file = open_appending(self.at)
        if try_lock(file):
            return file
        file.close()
        self.at = claim(self._path)
        file = open_appending(self.at)
        try_lock(file)
        self._say_once(
            "shared",
            f"The flight log {self._path} is written by another edgevpr: this flight is in {self.at}. Give each flight "
            "a `log.path` of its own.",
        )
        return file

    def set_aside(self) -> bool:
        """Give the file that is written a number, so that `open` makes a new one. Return False where it stays as it is:
        it is then written on, since a line is worth more than a limit."""
        try:
            if self.at == self._path:
                set_aside(self._path)
            else:
                self.at = claim(self._path)
        except OSError as error:
            self._say_once(
                "stays",
                f"The flight log {self._path} cannot be set aside ({error.strerror}), so it is written on, and may "
                "grow past log.max_mb: let the flight write to its folder.",
            )
            return False
        return True

    def delete_oldest(self) -> None:
        """Delete the oldest files with a number until a new file has its room. A failure is logged, not raised."""
        if math.isinf(self.part_bytes):
            return
        try:
            deleted = keep_within(self._path, self.part_bytes * (_PARTS - 1))
        except OSError as error:
            self._say_once(
                "grows",
                f"The oldest flight logs beside {self._path} cannot be deleted ({error.strerror}), so they grow past "
                "log.max_mb: let the flight write to their folder.",
            )
            return
        if deleted:
            self._say_once(
                "deleted", f"Old flight logs are deleted, {deleted[0]} first: all together stay within log.max_mb."
            )

    def _say_once(self, what: str, sentence: str) -> None:
        if what not in self._said:
            self._said.add(what)
            _log.warning("%s", sentence)


def identity(file: BinaryIO) -> tuple[int, int]:
    """Return the device and the number of an open file: those of no other file that is there."""
    found = os.fstat(file.fileno())
    return found.st_dev, found.st_ino


def size_of(file: BinaryIO) -> int:
    """Return the bytes of an open file, 0 for a device."""
    found = os.fstat(file.fileno())
    return found.st_size if stat.S_ISREG(found.st_mode) else 0
