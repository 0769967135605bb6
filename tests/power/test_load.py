"""The load of the machine, as psutil sees it, and what this process has of it."""

import os
import time

import pytest

from edgevpr.power.load import OwnLoad, machine_load
from edgevpr.types import StageCost


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


class Clocks:
    """Wall and CPU-seconds that the test moves on."""

    def __init__(self):
        self.now_s, self.cpu_s = 50.0, 3.0
        self.load = OwnLoad(4, lambda: self.now_s, lambda: self.cpu_s)

    def work(self, wall_s, ran_s):
        """Work of one thread that ran for `ran_s` of `wall_s`."""
        self.now_s += wall_s
        self.cpu_s += ran_s
        self.load.busy(StageCost(wall_s, ran_s))


def test_the_share_of_all_cores_counts_what_no_work_explains_too():
    clocks = Clocks()
    clocks.work(0.5, 0.5)
    clocks.now_s += 1.5
    clocks.cpu_s += 0.3  # another thread decodes a stream
    assert clocks.load.age_s == 2.0
    assert clocks.load.look() == (pytest.approx(0.8 / 2 / 4), 0.0)
    assert clocks.load.age_s == 0.0
    clocks.now_s += 1.0
    assert clocks.load.look() == (0.0, 0.0), "since the last look"


def test_work_is_late_only_where_its_thread_was_kept_waiting():
    clocks = Clocks()
    clocks.work(0.99, 0.97)
    clocks.now_s += 0.01
    assert clocks.load.look()[1] == 0.0, "it takes all the time, and nobody else does"
    clocks.work(0.9, 0.5)
    clocks.now_s += 0.1
    assert clocks.load.look()[1] == pytest.approx(0.9)


def test_two_looks_at_the_same_moment_say_nothing():
    clocks = Clocks()
    assert clocks.load.look() == clocks.load.look() == (0.0, 0.0)


def test_the_own_share_of_the_real_machine():
    load = OwnLoad(os.cpu_count())
    until_s, before_s = time.process_time() + 0.1, time.monotonic()
    while time.process_time() < until_s:
        pass
    share, _ = load.look()
    assert share == pytest.approx(0.1 / (time.monotonic() - before_s) / os.cpu_count(), rel=0.2)
