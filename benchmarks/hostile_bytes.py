"""Hostile bytes: random ones, streams that are damaged, and packets of any content with a right checksum or signature,
heard by the whole of a link but its port: parser, signing, the choice of the autopilot, and what it says."""

import gc
import hashlib
import logging
import random
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from base import Row

from edgevpr.mavlink.conversation import Conversation, LinkSettings
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.signing import NOT_SIGNING, TICKS_S, Signing, TimeStamps
from edgevpr.mavlink.wire import mavlink

BYTES = 10  # times as many bytes as packets are tried
BATCH = 500  # packets between two looks at what the link says
SENDERS = 20  # addresses of a listening port
KEY, OTHER_KEY = bytes(range(32)), bytes(32)
_KINDS = tuple(mavlink.mavlink_map.values())
_PAGE_MB = 4096 / 1e6


class Clock:
    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


class Maker:
    """Makes packets from a seed. Signed ones have time stamps that go on with the clock of their hearer."""

    def __init__(self, rng: random.Random, stamp: int) -> None:
        self.rng, self._start, self._stamp = rng, stamp, stamp
        self.recorded = b""  # a true message

    def packet(self, *, length: int | None = None, system_id: int = 1, component_id: int = 1, flags: int = 0) -> bytes:
        """Make a message of any kind with any content and a right checksum; `length` is not always the kind's own."""
        kind = self.rng.choice(_KINDS)
        payload = self.rng.randbytes(kind.unpacker.size if length is None else length)
        head = bytes([len(payload), flags, 0, self.rng.randrange(256), system_id, component_id])
        covered = head + kind.id.to_bytes(3, "little") + payload
        crc = mavlink.x25crc(covered + bytes([kind.crc_extra])).crc
        return b"\xfd" + covered + crc.to_bytes(2, "little")

    def signed(self, key: bytes = KEY, stamp: int | None = None, **header: int) -> bytes:
        self._stamp += 1000
        packet = self.packet(flags=mavlink.MAVLINK_IFLAG_SIGNED, **header)
        packet += b"\x00" + (self._stamp if stamp is None else stamp).to_bytes(6, "little")
        return packet + hashlib.sha256(key + packet).digest()[:6]

    def mutated(self, packet: bytes) -> bytes:
        """Flip some bits, or cut, or double, or lose a part."""
        way, at = self.rng.randrange(4), self.rng.randrange(len(packet))
        if way == 0:
            changed = bytearray(packet)
            for _ in range(self.rng.randint(1, 8)):
                changed[self.rng.randrange(len(packet))] ^= 1 << self.rng.randrange(8)
            return bytes(changed)
        to = self.rng.randrange(at, len(packet)) + 1
        return (packet[:at], packet[:to] + packet[at:], packet[:at] + packet[to:])[way - 1]

    def any_header(self, make: Callable[..., bytes]) -> bytes:
        one_of = self.rng.randrange
        return make(length=one_of(256), system_id=one_of(256), component_id=one_of(256))

    def forged(self) -> bytes:
        """Make a message with another key, of a time before the autopilot's or far ahead; the autopilot's own again, or
        one without a signature."""
        before, far = self.rng.randrange(self._start), self._start + self.rng.randrange(2**40, 2**46)
        return self.rng.choice(
            (
                lambda: self.signed(OTHER_KEY, self.rng.choice((before, far))),
                lambda: self.signed(stamp=before),
                lambda: self.signed(stamp=self.rng.choice((before, far)), system_id=self.rng.randrange(2, 256)),
                lambda: self.recorded,
                lambda: self.packet(),
            )
        )()


def _beginnings(maker: Maker) -> bytes:
    """Make ten bytes, among them more beginnings of messages than chance has."""
    return bytes(maker.rng.choice((0xFD, 0xFE, 0, 1, 255, maker.rng.randrange(256))) for _ in range(BYTES))


# Kind: whether there is a key, and what makes the next packet of it, or ten bytes.
KINDS: dict[str, tuple[bool, Callable[[Maker], bytes]]] = {
    "random bytes": (False, lambda maker: maker.rng.randbytes(BYTES)),
    "random bytes, with a key": (True, lambda maker: maker.rng.randbytes(BYTES)),
    "beginnings of messages": (False, _beginnings),
    "changed anywhere": (False, lambda maker: maker.mutated(maker.packet())),
    "any content, right checksum": (False, lambda maker: maker.packet()),
    "any header and length, right checksum": (False, lambda maker: maker.any_header(maker.packet)),
    "signed, changed anywhere": (True, lambda maker: maker.mutated(maker.signed())),
    "signed, any content": (True, lambda maker: maker.signed()),
    "signed, any header and length": (True, lambda maker: maker.any_header(maker.signed)),
    "forged, old, replayed or unsigned": (True, Maker.forged),
}


class Hearer:
    """A link without its port, which knows its autopilot. Its clock goes on by a hundredth of a second a packet."""

    def __init__(self, rng: random.Random, folder: Path, with_key: bool) -> None:
        self.clock = Clock()
        stamps = TimeStamps(folder / "time", self.clock, lambda: 1.8e9 + self.clock.now_s)
        signing = Signing(KEY, stamps) if with_key else NOT_SIGNING
        self.conversation = Conversation(LinkSettings(signing=signing), self.clock)
        self.conversation.want_position()
        self.maker = Maker(rng, stamps.next())
        self.failures: list[str] = []
        beat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4, 3)
        packer = mavlink.MAVLink(None, 1, 1)
        if with_key:
            packer.signing.sign_outgoing, packer.signing.secret_key = True, KEY
            packer.signing.timestamp = stamps.next() + TICKS_S // 1000
        self.maker.recorded = beat.pack(packer)
        assert self.conversation.hear(self.maker.recorded, self.clock(), None)

    def hear(self, packets: list[bytes], senders: int) -> None:
        """Hear packets from one or many senders, then say what is to be said, a fix among it."""
        sender = ("192.0.2.1", self.maker.rng.randrange(senders)) if senders > 1 else None
        for packet in packets:
            self.clock.now_s += 0.01
            self._try(lambda packet=packet: self.conversation.hear(packet, self.clock.now_s, sender))
        self._try(self._speak)

    def _speak(self) -> None:
        self.conversation.fixes.put(Fix(50.0, 8.0, 20.0, self.clock.now_s), self.clock.now_s)
        while (said := self.conversation.next_packet()) is not None:
            if said[1]:
                self.conversation.note_departed([said[1]])
        self.conversation.tell_of_answers()
        self.conversation.autopilot.vehicle_at(self.clock.now_s)

    def _try(self, act: Callable[[], object]) -> None:
        try:
            act()
        except Exception as error:  # which of them does not matter: none is right
            self.failures.append(repr(error))


def run(count: int, seed: int) -> list[Row]:
    """Try `count` packets of every kind, and ten times as many bytes of the kinds that are no packets."""
    rng, logger = random.Random(seed), logging.getLogger("edgevpr.mavlink")
    level, logger.level = logger.level, logging.CRITICAL  # thousands of warnings are what is wanted
    try:
        return [_row(kind, *made, count, rng) for kind, made in KINDS.items()]
    finally:
        logger.level = level


def _row(kind: str, with_key: bool, make: Callable[[Maker], bytes], count: int, rng: random.Random) -> Row:
    """Return what was tried, and what came of it. `believed` are the messages of a known kind that came through, among
    them the autopilot's own first, and those that a change has left whole. `grown_mb` is what the process has grown by
    since the first tenth."""
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:  # the time may just be being kept in it
        hearer = Hearer(rng, Path(folder), with_key)
        done = 0
        before_mb = None
        while done < count:
            packets = [make(hearer.maker) for _ in range(min(BATCH, count - done))]
            hearer.hear(packets, senders=SENDERS if done // BATCH % 2 else 1)
            done += len(packets)
            if before_mb is None and done >= count / 10:
                before_mb = _rss_mb()
        grown_mb, received = _rss_mb() - before_mb, hearer.conversation.reader.received
    return {
        "kind": kind,
        "packets": count,
        "believed": received.total() - received["UNKNOWN"],
        "exceptions": len(hearer.failures),
        "grown_mb": round(grown_mb, 1),
    }


def _rss_mb() -> float:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE_MB
