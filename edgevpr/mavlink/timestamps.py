"""Time stamps of signed messages. They never go back, neither in a flight nor from one flight to the next."""

import logging
import time
from collections.abc import Callable
from pathlib import Path
from threading import Lock, Thread

from edgevpr.core.errors import ConfigError
from edgevpr.core.files import read_file, write_whole

TICKS_S = 100_000  # a time stamp counts units of 10 microseconds since the beginning of 2015, UTC
_EPOCH_S = 1_420_070_400
_LATEST = 2**48 - 1  # it has six bytes
_NEAR = 60 * TICKS_S
_KEPT_EVERY = 30 * TICKS_S
# At a start the time stamps move on by a minute beyond the largest that can have been used. So nothing that was sent
# before, to us or by us, is less than a minute old, and a replay of it passes for no new stream.
_MOVED_ON = _KEPT_EVERY + 60 * TICKS_S

_STREAMS_MAX = 64  # far more than are on the air; invented ones must not fill the memory

OLD, FUTURE, CROWDED = "old time stamp", "time stamp from the future", "too many senders"

Stream = tuple[int, int, int]  # system, component and link id of a sender

log = logging.getLogger(__name__)


class TimeStamps:
    """The largest time stamp that was ever sent or received, and the last of every stream; any thread may ask.

    The largest is kept in a file, since a board without a clock chip begins with an old time: it is written at the
    start, raises ConfigError where it is damaged or cannot be made, and from then on every half minute.
    """

    def __init__(
        self, path: Path, mono_s: Callable[[], float] = time.monotonic, utc_s: Callable[[], float] = time.time
    ) -> None:
        self._path, self._mono_s, self._utc_s = path, mono_s, utc_s
        self._lock, self._writing = Lock(), Lock()
        self._streams: dict[Stream, int] = {}
        self._said = False
        self._written = _read(path)
        self._rebase(self._written + _MOVED_ON)
        self._largest = self._kept = self._now()
        try:
            self._write(self._kept)
        except OSError as error:
            if not path.exists():
                raise ConfigError(
                    f"{path}: the time of signed messages cannot be kept there ({error.strerror}): correct "
                    "`mavlink: {signing_state: ...}`."
                ) from error
            self._say_not_kept(error)

    def next(self) -> int:
        """Return the time stamp of the next message to be sent, which is larger than any before."""
        with self._lock:
            self._move_on(max(self._largest + 1, self._now()))
            return min(self._largest, _LATEST)

    def refusal(self, stream: Stream, stamp: int) -> str | None:
        """Return why a message with this time stamp is refused, in a few words. Return None where it is admitted, and
        take note of it: so this must be asked only of a message whose signature is right.

        A stream must go on. A new one must be within a minute of the largest time stamp, except that the first of all
        may be ahead by any time: it is how a board without a clock chip learns the time.
        """
        with self._lock:
            now = max(self._largest, self._now())
            if stamp <= self._streams.get(stream, now - _NEAR):
                return OLD
            if stream not in self._streams:
                if self._streams and stamp > now + _NEAR:
                    return FUTURE
                if self._is_crowded(now):
                    return CROWDED
            self._streams[stream] = stamp
            if stamp > now:
                self._rebase(stamp)
                self._move_on(stamp)
            return None

    def _is_crowded(self, now: int) -> bool:
        if len(self._streams) >= _STREAMS_MAX:
            # What these have sent stays refused: as a new stream's it would be older than a minute.
            self._streams = {stream: last for stream, last in self._streams.items() if last > now - _NEAR}
        return len(self._streams) >= _STREAMS_MAX

    def _now(self) -> int:
        """Return the time of the system's clock, or that which has gone on since the largest time was learnt."""
        by_system = int((self._utc_s() - _EPOCH_S) * TICKS_S)
        return max(by_system, self._base + int((self._mono_s() - self._base_s) * TICKS_S))

    def _rebase(self, stamp: int) -> None:
        self._base, self._base_s = stamp, self._mono_s()

    def _move_on(self, stamp: int) -> None:
        self._largest = stamp
        if stamp - self._kept >= _KEPT_EVERY:
            self._kept = stamp
            # Not in the thread of a link: a slow card must not hold up a fix.
            Thread(target=self._keep, args=(stamp,), name="signing time", daemon=True).start()

    def _keep(self, stamp: int) -> None:
        try:
            self._write(stamp)
        except OSError as error:
            self._say_not_kept(error)

    def _write(self, stamp: int) -> None:
        with self._writing:
            if stamp > self._written:  # two that are written at once may come in any order
                write_whole(self._path, lambda path: path.write_text(f"{stamp}\n"))
                self._written = stamp

    def _say_not_kept(self, error: OSError) -> None:
        if not self._said:
            self._said = True
            log.warning("%s: the time of signed messages is not kept (%s)", self._path, error.strerror)


class BorrowedTimeStamps(TimeStamps):
    """Time stamps for a program that only asks: the file is read, and never written. It may run as root, whose file the
    service could not write.

    So the next flight does not know what was sent meanwhile. It need not: with a link id of its own the program is
    another stream, which the autopilot compares with the flight's only for whether a new one is a minute old. Both
    begin at the same kept time, and the program ends within that minute.
    """

    def _write(self, stamp: int) -> None:
        """Do nothing."""


def _read(path: Path) -> int:
    """Read the kept time stamp, 0 where there is none."""
    try:
        text = read_file(path, 64).decode("ascii", "replace").strip()
    except FileNotFoundError:
        return 0
    except OSError as error:
        raise ConfigError(f"{path}: the time of signed messages cannot be read ({error.strerror}).") from error
    if not (text.isascii() and text.isdigit() and int(text) <= _LATEST):
        raise ConfigError(f"{path} holds no time of signed messages: set the clock, and delete the file.")
    return int(text)
