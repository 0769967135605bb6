"""What the machine has: read from trees that stand for /proc and /sys, and from the real ones."""

import mmap
import os

import pytest

from edgevpr.power import machine

MEMINFO = "MemTotal:        2000000 kB\nMemFree:          100000 kB\n"
SERVICE = "1:cpu:/\n0::/system.slice/edgevpr.service\n"


def test_read_ram_limit_is_that_of_the_machine_without_control_groups(tree):
    root = tree({"proc/meminfo": MEMINFO})
    assert machine.read_ram_limit_mb(root) == machine.read_ram_mb(root) == 2048.0
    assert machine.count_usable_cores(root) == len(os.sched_getaffinity(0))


@pytest.mark.parametrize(("above", "limit_mb"), [("max", 536.870912), ("100000000", 100.0)])
def test_read_ram_limit_is_the_lowest_of_the_control_groups(tree, above, limit_mb):
    slice_of_system = "sys/fs/cgroup/system.slice"
    limits = {f"{slice_of_system}/edgevpr.service/memory.max": "536870912\n", f"{slice_of_system}/memory.max": above}
    root = tree({"proc/meminfo": MEMINFO, "proc/self/cgroup": SERVICE} | limits)
    assert machine.read_ram_limit_mb(root) == limit_mb
    assert machine.read_ram_mb(root) == 2048.0


@pytest.mark.parametrize(("quota", "expected"), [("50000 100000", 0.5), ("max 100000", None)])
def test_cores_obey_the_quota_of_the_service(tree, quota, expected):
    root = tree({"proc/self/cgroup": SERVICE, "sys/fs/cgroup/system.slice/edgevpr.service/cpu.max": f"{quota}\n"})
    assert machine.count_usable_cores(root) == (expected or len(os.sched_getaffinity(0)))


def test_cores_obey_the_affinity_of_the_process(tree):
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        assert machine.count_usable_cores(tree({})) == 1
    finally:
        os.sched_setaffinity(0, allowed)


def test_rss_grows_with_the_memory_that_the_process_touches():
    before_mb = machine.read_rss_mb()
    with mmap.mmap(-1, 30_000_000) as held:  # pages of its own: other memory may come from what tests before have freed
        held.write(os.urandom(30_000_000))
        grown_mb = machine.read_rss_mb() - before_mb
    assert 25 < grown_mb < 100
    assert machine.read_rss_mb() < machine.read_ram_limit_mb() <= machine.read_ram_mb()
    assert 0 < machine.count_usable_cores() <= os.cpu_count()
