"""The load of the machine, as psutil sees it, and what this process has of it."""

import os
import time

import pytest
from fakes import FakeClock

from edgevpr.core.types import StageCost
from edgevpr.power.load import OwnLoad, machine_load


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


class Working(FakeClock):
    """The load of a process, by a clock of its own."""

    def __init__(self):
        super().__init__()
        self.load = OwnLoad(4, self, lambda: self.cpu_s)

    def work(self, wall_s, ran_s):
        """Work of one thread that ran for `ran_s` of `wall_s`."""
        super().work(wall_s, ran_s / wall_s)
        self.load.busy(StageCost(wall_s, ran_s))


def test_the_share_of_all_cores_counts_what_no_work_explains_too():
    clocks = Working()
    clocks.work(0.5, 0.5)
    clocks.now_s += 1.5
    clocks.cpu_s += 0.3  # another thread decodes a stream
    assert clocks.load.age_s == 2.0
    assert clocks.load.look() == (pytest.approx(0.8 / 2 / 4), 0.0)
    assert clocks.load.age_s == 0.0
    clocks.now_s += 1.0
    assert clocks.load.look() == (0.0, 0.0), "since the last look"


def test_work_is_late_only_where_its_thread_was_kept_waiting():
    clocks = Working()
    clocks.work(0.99, 0.97)
    clocks.now_s += 0.01
    assert clocks.load.look()[1] == 0.0, "it takes all the time, and nobody else does"
    clocks.work(0.9, 0.5)
    clocks.now_s += 0.1
    assert clocks.load.look()[1] == pytest.approx(0.9)


def test_two_looks_at_the_same_moment_say_nothing():
    clocks = Working()
    assert clocks.load.look() == clocks.load.look() == (0.0, 0.0)


def test_the_own_share_of_the_real_machine():
    moments = [(time.monotonic(), time.process_time())]
    load = OwnLoad(os.cpu_count())
    moments.append((time.monotonic(), time.process_time()))
    while time.process_time() < moments[0][1] + 0.1:
        pass
    moments.append((time.monotonic(), time.process_time()))
    share, _ = load.look()
    moments.append((time.monotonic(), time.process_time()))
    (first_s, first_cpu_s), (begun_s, begun_cpu_s), (done_s, done_cpu_s), (last_s, last_cpu_s) = moments
    # However long another program has the core in between.
    assert (done_cpu_s - begun_cpu_s) / (last_s - first_s) <= share * os.cpu_count()
    assert share * os.cpu_count() <= (last_cpu_s - first_cpu_s) / (done_s - begun_s)
