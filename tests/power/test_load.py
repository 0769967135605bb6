"""The load of the machine, as psutil sees it."""

import os
import time

from edgevpr.power.load import machine_load


def test_a_busy_core_is_seen():
    machine_load()
    until_s = time.monotonic() + 0.3
    while time.monotonic() < until_s:
        pass
    load = machine_load()
    assert len(load.core_shares) == os.cpu_count()
    assert max(load.core_shares) > 0.5
    assert all(0 <= share <= 1 for share in load.core_shares)
    assert 0 < load.ram_used_bytes < load.ram_total_bytes
