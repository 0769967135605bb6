"""Whatever comes over the wire, the receiver goes on: what is a message arrives, what is none is counted."""

import random

from scripted_autopilot import Autopilot

from edgevpr.mavlink.wire import PacketReader, mavlink


def make_packets_of_every_kind(rng: random.Random, system_id: int = 1) -> list[bytes]:
    packer = mavlink.MAVLink(None, system_id, 1)
    packets = []
    for kind in mavlink.mavlink_map.values():
        message = mavlink.MAVLink_message(kind.id, kind.msgname)
        packets.append(message._pack(packer, kind.crc_extra, rng.randbytes(kind.unpacker.size)))
    return packets


def test_damaged_packets_and_noise_never_raise_and_are_counted():
    rng = random.Random(2)
    packets = make_packets_of_every_kind(rng)
    receiver = PacketReader()
    for _ in range(5000):
        packet = bytearray(rng.choice(packets))
        harm = rng.randrange(5)
        if harm == 0:
            packet[rng.randrange(len(packet))] ^= 1 << rng.randrange(8)
        elif harm == 1:
            packet = packet[: rng.randrange(len(packet))]
        elif harm == 2:
            packet = rng.randbytes(rng.randrange(300))
        elif harm == 3:
            packet = bytes([rng.choice((0xFD, 0xFE))]) * rng.randrange(300)
        for _ in receiver.feed(bytes(packet)):
            pass
    assert receiver.bad_bytes > 10_000
    assert sum(receiver.received.values()) > 200
    assert len(receiver.received) <= len(packets) + 1  # messages of unknown number share one name


def test_conversation_accepts_any_content_of_autopilot_messages():
    rng, autopilot = random.Random(3), Autopilot()
    for _ in range(10):
        for packet in make_packets_of_every_kind(rng, system_id=7):
            autopilot.wait(0.01)
            autopilot.conversation.handle(packet, autopilot.clock.now_s, None)
        autopilot.put_fix()
        autopilot.take_sent()
        autopilot.predict(autopilot.clock.now_s)
    received = autopilot.conversation.reader.received
    assert received.total() - received["UNKNOWN"] > 10 * 300
