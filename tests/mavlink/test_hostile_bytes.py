"""A short form of `benchmarks/hostile_bytes.py`: no exception, no growth, and nothing forged is believed."""

import random
import tracemalloc

import hostile_bytes
import pytest


def test_no_byte_and_no_packet_raises_and_nothing_forged_is_believed():
    rows = {row.kind: row for row in hostile_bytes.run(count=3000, seed=5)}
    assert [row.exceptions for row in rows.values()] == [0] * len(rows)
    believed = {kind: row.believed for kind, row in rows.items()}
    assert believed["any content, right checksum"] == 3001, "nothing came through, so nothing was tried"
    assert believed["signed, any content"] == 3001
    assert believed["forged, old, replayed or unsigned"] == 1, "all but the autopilot's own first heartbeat is forged"


@pytest.mark.parametrize("kind", [*hostile_bytes.BYTE_KINDS, *hostile_bytes.KINDS])
def test_hearing_does_not_grow(kind, tmp_path, caplog):
    caplog.set_level("CRITICAL", "edgevpr.mavlink")
    with_key, make = (hostile_bytes.BYTE_KINDS | hostile_bytes.KINDS)[kind]
    hearer = hostile_bytes.Hearer(random.Random(3), tmp_path, with_key)

    def hear(times: int) -> int:
        for number in range(times):
            hearer.hear([make(hearer.maker) for _ in range(100)], senders=1 + number % 2 * hostile_bytes.SENDERS)
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        before = hear(20)
        after = hear(20)
    finally:
        tracemalloc.stop()
    assert hearer.failures == []
    assert after - before < 60_000, "two thousand messages more must not take 30 bytes each"
