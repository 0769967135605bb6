"""What this machine has and what this process takes of it, as the kernel says in /proc and /sys.

`root` is the root of the file system: another tree can stand in its place. A megabyte is 10^6 bytes.
"""

import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

_ROOT = Path("/")


def model(root: Path = _ROOT) -> str | None:
    """The board's name in the device tree, e.g. "Raspberry Pi 4 Model B Rev 1.4"; None where there is none (x86)."""
    try:
        return (root / "proc/device-tree/model").read_text().strip("\0\n ")
    except OSError:
        return None


def cores(root: Path = _ROOT) -> float:
    """Cores that this process may use: its CPU affinity, and the quota (cpu.max) of its control groups."""
    usable = float(len(os.sched_getaffinity(0)))
    for quota_us, period_us in _cgroup_limits("cpu.max", root):
        usable = min(usable, int(quota_us) / int(period_us))
    return usable


def ram_mb(root: Path = _ROOT) -> float:
    """Memory of the machine."""
    return _kib_line(root / "proc/meminfo", "MemTotal:")


def ram_limit_mb(root: Path = _ROOT) -> float:
    """Memory that this process may use: the machine's, and the limit (memory.max) of its control groups."""
    return min([ram_mb(root), *(int(limit) / 1e6 for (limit,) in _cgroup_limits("memory.max", root))])


def rss_mb(root: Path = _ROOT) -> float:
    """Resident memory of this process, pages that it shares with others included."""
    resident_pages = int((root / "proc/self/statm").read_text().split()[1])
    return resident_pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def pss_mb(root: Path = _ROOT) -> float | None:
    """Memory of this process with shared pages counted in proportion; None where the kernel does not say."""
    try:
        return _kib_line(root / "proc/self/smaps_rollup", "Pss:")
    except OSError:
        return None


def _kib_line(path: Path, label: str) -> float:
    """The figure of a line "label  1234 kB", in MB."""
    line = next(line for line in path.read_text().splitlines() if line.startswith(label))
    return int(line.split()[1]) * 1024 / 1e6


def _cgroup_limits(name: str, root: Path) -> Iterator[list[str]]:
    """The words of a limit file (cgroup v2) of this process's group and of every group above it: each one binds."""
    try:
        memberships = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for group in (PurePosixPath(line.removeprefix("0::")) for line in memberships if line.startswith("0::")):
        for level in (group, *group.parents):
            try:
                words = (root / "sys/fs/cgroup" / level.relative_to("/") / name).read_text().split()
            except OSError:  # the group of the root has no limits, and not every kernel has every controller
                continue
            if words[0] != "max":
                yield words
