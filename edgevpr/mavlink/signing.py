"""Signing of MAVLink 2: the key, the signatures of sent and received messages, and their timestamps, which never go
back, neither within a flight nor between flights. Used by the link and by `edgevpr check` and `doctor`.

pymavlink signs sent messages. Its check of received messages is not used: it stores the timestamp of a message before
it compares the signature, so a single forged message with a timestamp far in the future would block all valid ones."""

import hashlib
import hmac
import logging
import os
import stat
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from threading import Lock, Thread

from edgevpr.core.config import MavlinkConfig
from edgevpr.core.errors import ConfigError
from edgevpr.core.files import open_file, read_file, write_atomically
from edgevpr.mavlink.wire import Message, mavlink

TICKS_S = 100_000  # per second: a timestamp counts units of 10 microseconds since the start of 2015, UTC
_EPOCH_S = 1_420_070_400
_MAX_STAMP = 2**48 - 1  # timestamps have six bytes
_MAX_STREAM_OFFSET = 60 * TICKS_S
_SAVE_INTERVAL = 30 * TICKS_S
# Each start adds a minute to the largest timestamp that may have been used. All earlier messages, sent and received,
# are then more than a minute old and cannot be replayed as a new stream.
_START_ADVANCE = _SAVE_INTERVAL + 60 * TICKS_S

KEY_BYTES = 32
# Link ids. A receiver checks the timestamps of each stream (system, component and link id) separately.
AUTOPILOT_LINK_ID = 1
CHECK_LINK_ID = 2  # used by `edgevpr check` and `doctor`
UNSIGNED = "unsigned"
WRONG = "wrong signature"
OLD = "old time stamp"
FUTURE = "time stamp from the future"
_KEY_ADVICE = "create one with `(umask 077; head -c 32 /dev/urandom > FILE)`"

REFUSAL_MEANINGS = {
    UNSIGNED: "the other end does not sign: configure the key there, or remove `mavlink.signing_key`",
    WRONG: "the other end has a different key, or the messages are forged",
    OLD: "normal just after a start; otherwise messages are replayed, or the other end does not receive ours",
    FUTURE: "the clock of this sender is wrong, or the clocks of all other senders",
}

Stream = tuple[int, int, int]  # system, component and link id of a sender
Clock = Callable[[], float]

log = logging.getLogger(__name__)


class TimeStamps:
    """The largest timestamp ever sent or received, and the last one of every stream (the messages of one sender with
    one link id). Any thread may call it. The largest is saved in the file `path`, because a board without a real-time
    clock starts with an old time. It is written at the start (raises ConfigError), and then every half minute.

    If `is_saved` is False the file is only read. A check before the flight does so, because it may run as root, and the
    service could not overwrite a file of root."""

    def __init__(
        self, path: Path, mono_s: Clock = time.monotonic, utc_s: Clock = time.time, is_saved: bool = True
    ) -> None:
        self._path, self._mono_s, self._utc_s, self._is_saved = path, mono_s, utc_s, is_saved
        self._lock, self._writing = Lock(), Lock()
        self._streams: dict[Stream, int] = {}
        self._has_warned = False
        self._rebase(_read_stamp(path) + _START_ADVANCE)
        self._largest = self._saved = self._now()
        self._save(may_fail=not path.exists())

    def next(self) -> int:
        """Return the timestamp for the next message to send, larger than all previous ones."""
        with self._lock:
            self._advance(max(self._largest + 1, self._now()))
            return min(self._largest, _MAX_STAMP)

    def check(self, stream: Stream, stamp: int) -> str | None:
        """Return why a message with this timestamp is rejected, or None if it is admitted. An admitted timestamp is
        stored, so check the signature first. The timestamps of a stream must increase. The first of a new stream must
        be within a minute of the largest. The very first may be ahead: it sets the time of a board without a clock."""
        with self._lock:
            now = max(self._largest, self._now())
            if stamp <= self._streams.get(stream, now - _MAX_STREAM_OFFSET):
                return OLD
            if self._streams and stream not in self._streams and stamp > now + _MAX_STREAM_OFFSET:
                return FUTURE
            self._streams[stream] = stamp
            if stamp > now:
                self._rebase(stamp)
                self._advance(stamp)
            return None

    def _now(self) -> int:
        """Return the current timestamp: that of the system clock or, if later, of the base and the monotonic clock."""
        system_stamp = int((self._utc_s() - _EPOCH_S) * TICKS_S)
        return max(system_stamp, self._base + int((self._mono_s() - self._base_s) * TICKS_S))

    def _rebase(self, stamp: int) -> None:
        self._base, self._base_s = stamp, self._mono_s()

    def _advance(self, stamp: int) -> None:
        self._largest = stamp
        if stamp - self._saved >= _SAVE_INTERVAL:
            self._saved = stamp
            # Not on a link's thread: a slow SD card must not delay a fix.
            Thread(target=self._save, name="signing time", daemon=True).start()

    def _save(self, may_fail: bool = False) -> None:
        """Save the timestamp to the file. If that fails, log one warning or, with `may_fail`, raise ConfigError."""
        if not self._is_saved:
            return
        try:
            with self._writing:
                write_atomically(self._path, lambda path: path.write_text(f"{self._saved}\n"))
        except OSError as error:
            if may_fail:
                fault = f"the signing timestamp cannot be saved to this file ({error.strerror})"
                raise ConfigError(f"{self._path}: {fault}: correct `mavlink: {{signing_state: ...}}`.") from error
            if not self._has_warned:
                self._has_warned = True
                log.warning("%s: cannot save the signing timestamp (%s)", self._path, error.strerror)


class Signing:
    """Signs the messages that a link sends, and admits received messages that are signed with the same key and not
    older than earlier ones. `refused` counts the others by reason. `verdicts` holds the reason for each message of the
    last read (None: admitted). Without a key (no `stamps`) nothing is signed, and every message is admitted."""

    def __init__(self, key: bytes = b"", stamps: TimeStamps | None = None, link_id: int = AUTOPILOT_LINK_ID) -> None:
        self.refused: Counter[str] = Counter()
        self._key, self._stamps, self._link_id = key, stamps, link_id
        self.verdicts: list[str | None] = []

    def stamp(self, packer: Message) -> None:
        """Make a pymavlink packer sign its next message."""
        if self._stamps:
            signing = packer.signing
            signing.sign_outgoing, signing.secret_key, signing.link_id = True, self._key, self._link_id
            signing.timestamp = self._stamps.next()

    def admits(self, message: Message) -> bool:
        """Return True if a received message may be processed."""
        if not self._stamps:
            return True
        reason = self._find_refusal(self._stamps, message.get_msgbuf(), message.get_header())
        self.verdicts.append(reason)
        if reason is None:
            return True
        if reason not in self.refused:
            log.warning("rejecting messages (%s): %s", reason, REFUSAL_MEANINGS[reason])
        self.refused[reason] += 1
        return False

    def _find_refusal(self, stamps: TimeStamps, packet: bytes, header: Message) -> str | None:
        """Return why a message is rejected (None: it is admitted). A RADIO_STATUS needs no signature, because a radio
        has no key, but must not have the component id of an autopilot."""
        if not header.incompat_flags & mavlink.MAVLINK_IFLAG_SIGNED:
            is_status = header.msgId == mavlink.MAVLINK_MSG_ID_RADIO_STATUS
            return None if is_status and header.srcComponent != mavlink.MAV_COMP_ID_AUTOPILOT1 else UNSIGNED
        # A signed packet ends with link id (1 byte), timestamp (6) and signature (6).
        expected = hashlib.sha256(self._key + packet[:-6]).digest()[:6]
        if not hmac.compare_digest(expected, packet[-6:]):
            return WRONG
        stamp = int.from_bytes(packet[-12:-6], "little")
        return stamps.check((header.srcSystem, header.srcComponent, packet[-13]), stamp)


NOT_SIGNING = Signing()


def open_signing(settings: MavlinkConfig, is_read_only: bool = False) -> Signing:
    """Open the signing with the configured key, if any. If `is_read_only` (a check before the flight), the timestamp
    file is not written. Raises ConfigError."""
    if settings.signing_key is None:
        return NOT_SIGNING
    key, state = read_key(settings.signing_key), Path(settings.signing_state or f"{settings.signing_key}.time")
    link_id = CHECK_LINK_ID if is_read_only else AUTOPILOT_LINK_ID
    return Signing(key, TimeStamps(state, is_saved=not is_read_only), link_id)


def read_key(path: str) -> bytes:
    """Read the 32-byte key from a file that only its owner may read. Raises ConfigError."""
    try:
        with open_file(path, 1_000_000) as handle:
            mode, key = stat.S_IMODE(os.fstat(handle.fileno()).st_mode), handle.read(KEY_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: the signing key cannot be read ({error.strerror}): {_KEY_ADVICE}.") from error
    # systemd provides a credential to this service alone; its access list appears as a group permission.
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    is_credential = folder is not None and Path(path).absolute().parent == Path(folder) and not mode & 0o037
    if mode & 0o077 and not is_credential:
        raise ConfigError(f"{path}: other users can read the signing key (mode {mode:04o}): run `chmod 600 {path}`.")
    if len(key) != KEY_BYTES:
        raise ConfigError(f"{path}: a signing key must be {KEY_BYTES} bytes long, and this file is not: {_KEY_ADVICE}.")
    return key


def _read_stamp(path: Path) -> int:
    """Read the saved timestamp from the file; 0 if there is no file. Raises ConfigError if the file is damaged."""
    try:
        text = read_file(path, 64).decode("ascii", "replace").strip()
    except FileNotFoundError:
        return 0
    except OSError as error:
        raise ConfigError(f"{path}: the signing timestamp cannot be read ({error.strerror}).") from error
    if not (text.isascii() and text.isdigit() and int(text) <= _MAX_STAMP):
        raise ConfigError(f"{path} contains no signing timestamp: set the board's clock, then delete the file.")
    return int(text)
