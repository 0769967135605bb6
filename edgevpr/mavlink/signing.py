"""Signing of MAVLink 2: the key, the signature of what is sent, and the check of what arrives.

pymavlink signs what is sent. It does not check what arrives: it would store the time stamp of a message before it
compares the signature, so that one forged message from the far future would shut out all true ones.
"""

import hashlib
import hmac
import logging
import os
import stat
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from edgevpr.core.errors import ConfigError
from edgevpr.core.files import open_file
from edgevpr.mavlink.timestamps import CROWDED, FUTURE, OLD, BorrowedTimeStamps, TimeStamps
from edgevpr.mavlink.wire import Message, mavlink

KEY_BYTES = 32
# Link ids: who hears us over two has two streams, each with its own time.
TO_AUTOPILOT, TO_GROUND, TO_ASK = 1, 2, 3
UNSIGNED, WRONG = "unsigned", "wrong signature"
_SIGNATURE_BYTES, _STAMP_BYTES = 6, 6
_BLOCK_BYTES = 1 + _STAMP_BYTES + _SIGNATURE_BYTES  # link id, time stamp, signature
_MAKE_ONE = "`(umask 077; head -c 32 /dev/urandom > FILE)` makes one"

MEANING = {
    UNSIGNED: "the other end does not sign: give it the key, or remove `mavlink.signing_key`",
    WRONG: "the other end has another key, or somebody forges them",
    OLD: "usual for a moment after a start; else they are sent again by somebody, or the other end does not hear us",
    FUTURE: "a clock of some sender is wrong, or those of all others are",
    CROWDED: "there are more of them than an aircraft and its ground have",
}

log = logging.getLogger(__name__)


class NotSigning:
    """Stands in for a `Signing` where there is no key: nothing is signed, and everything is admitted."""

    refused: Mapping[str, int] = MappingProxyType({})

    def of_ground(self) -> "NotSigning":
        """Return the same: there is nothing to keep apart."""
        return self

    def take_verdicts(self) -> list[str | None]:
        """Return none: nothing is judged."""
        return []

    def stamp(self, packer: mavlink.MAVLink) -> None:
        """Do nothing."""

    def admits(self, message: Message) -> bool:
        """Return True."""
        return True


NOT_SIGNING = NotSigning()


class Signing:
    """Signs what one link sends, and admits what is signed with the same key and not older than what came before.
    `refused` counts the rest by reason; each reason is said once."""

    def __init__(self, key: bytes, stamps: TimeStamps, link_id: int = TO_AUTOPILOT) -> None:
        self.refused: Counter[str] = Counter()
        self._key, self._stamps, self._link_id = key, stamps, link_id
        self._verdicts: list[str | None] = []

    def of_ground(self) -> "Signing":
        """Return that of the link to the ground: the same key and time, another link id."""
        return Signing(self._key, self._stamps, TO_GROUND)

    def take_verdicts(self) -> list[str | None]:
        """Return of every message since the last call why it was refused, None where it was admitted."""
        verdicts, self._verdicts = self._verdicts, []
        return verdicts

    def stamp(self, packer: mavlink.MAVLink) -> None:
        """Let a packer sign its next message."""
        signing = packer.signing
        signing.sign_outgoing, signing.secret_key, signing.link_id = True, self._key, self._link_id
        signing.timestamp = self._stamps.next()

    def admits(self, message: Message) -> bool:
        """Tell whether a message is to be believed, and count it where it is not. A RADIO_STATUS needs no signature,
        since a radio has no key; but it must not speak for an autopilot."""
        header = message.get_header()
        reason = self._refusal(message.get_msgbuf(), header)
        is_admitted = reason is None or (reason == UNSIGNED and _is_of_radio(header))
        self._verdicts.append(None if is_admitted else reason)
        if is_admitted:
            return True
        if reason not in self.refused:
            log.warning("messages are refused (%s): %s", reason, MEANING[reason])
        self.refused[reason] += 1
        return False

    def _refusal(self, packet: bytes, header: mavlink.MAVLink_header) -> str | None:
        if not header.incompat_flags & mavlink.MAVLINK_IFLAG_SIGNED:
            return UNSIGNED
        signed, signature = packet[:-_SIGNATURE_BYTES], packet[-_SIGNATURE_BYTES:]
        expected = hashlib.sha256(self._key + signed).digest()[:_SIGNATURE_BYTES]
        if not hmac.compare_digest(expected, signature):
            return WRONG
        stamp = int.from_bytes(packet[-_STAMP_BYTES - _SIGNATURE_BYTES : -_SIGNATURE_BYTES], "little")
        return self._stamps.refusal((header.srcSystem, header.srcComponent, packet[-_BLOCK_BYTES]), stamp)


def _is_of_radio(header: mavlink.MAVLink_header) -> bool:
    return header.msgId == mavlink.MAVLINK_MSG_ID_RADIO_STATUS and header.srcComponent != mavlink.MAV_COMP_ID_AUTOPILOT1


def open_signing(key_path: str | None, state_path: str | None) -> Signing | NotSigning:
    """Read the key and the time kept; without a key there is no signing. `state_path` is where the time is kept, None:
    beside the key. Raises ConfigError."""
    return _opened(key_path, state_path, TimeStamps, TO_AUTOPILOT)


def open_signing_to_ask(key_path: str | None, state_path: str | None) -> Signing | NotSigning:
    """Open the same for questions on the ground: the time that is kept is read, and not written. Raises ConfigError."""
    return _opened(key_path, state_path, BorrowedTimeStamps, TO_ASK)


def _opened(
    key_path: str | None, state_path: str | None, time_stamps: type[TimeStamps], link_id: int
) -> Signing | NotSigning:
    if key_path is None:
        return NOT_SIGNING
    key = read_key(key_path)
    return Signing(key, time_stamps(Path(state_path or f"{key_path}.time")), link_id)


def read_key(path: str) -> bytes:
    """Read a key of 32 bytes that nobody but its owner may read; raises ConfigError."""
    try:
        with open_file(path, 1_000_000) as handle:
            mode, key = stat.S_IMODE(os.fstat(handle.fileno()).st_mode), handle.read(KEY_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: the signing key cannot be read ({error.strerror}): {_MAKE_ONE}.") from error
    if mode & 0o077 and not _is_credential(path, mode):
        raise ConfigError(f"{path}: others may open the signing key (mode {mode:04o}): `chmod 600 {path}`.")
    if len(key) != KEY_BYTES:
        size = f"only {len(key)}" if len(key) < KEY_BYTES else "more"
        raise ConfigError(f"{path}: a signing key has {KEY_BYTES} bytes, and this file has {size}: {_MAKE_ONE}.")
    return key


def _is_credential(path: str, mode: int) -> bool:
    """Tell whether systemd gives this file to this service alone. It lets the service's user read it by an access list,
    which shows as the right of a group to read; the folder is open to nobody else."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    return folder is not None and Path(path).absolute().parent == Path(folder) and not mode & 0o037
