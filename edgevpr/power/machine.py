"""Hardware of this machine and memory of this process, as the kernel reports them in /proc and /sys.

`root`: root of the file system; tests pass another tree. A megabyte (MB) is 10^6 bytes."""

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath

_ROOT = Path("/")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


def read_model(root: Path = _ROOT) -> str | None:
    """Return the manufacturer's model name from the device tree ("Raspberry Pi 4 Model B Rev 1.4") or, on an x86
    machine, from the firmware (DMI); None if neither has one."""
    names = (read_text(root / "sys/class/dmi/id" / name) for name in ("sys_vendor", "product_name"))
    return read_text(root / "proc/device-tree/model") or " ".join(filter(None, names)) or None


def count_cores_online(root: Path = _ROOT) -> int:
    """Count the machine's online cores, including those that this process may not use."""
    spans = re.findall(r"(\d+)(?:-(\d+))?", read_text(root / "sys/devices/system/cpu/online") or "")
    return sum(int(last or first) - int(first) + 1 for first, last in spans) or os.cpu_count() or 1


def count_usable_cores(root: Path = _ROOT) -> float:
    """Return the number of cores that CPU affinity and cgroup quotas (cpu.max) allow this process to use."""
    quotas = (int(quota_us) / int(period_us) for quota_us, period_us in _read_cgroup_limits("cpu.max", root))
    return min([float(len(os.sched_getaffinity(0))), *quotas])


def read_ram_mb(root: Path = _ROOT) -> float:
    """Return the RAM of the machine in MB."""
    return _read_kib_line(root / "proc/meminfo", "MemTotal:")


def read_ram_limit_mb(root: Path = _ROOT) -> float:
    """Return the RAM in MB that this process may use: the machine's or the lowest memory.max of its cgroups."""
    return min([read_ram_mb(root), *(int(limit) / 1e6 for (limit,) in _read_cgroup_limits("memory.max", root))])


def read_rss_mb(root: Path = _ROOT) -> float:
    """Return the resident memory (RSS) of this process in MB, including pages that it shares with other processes."""
    # Called twice per query; `read_text` would take three times as long.
    with open(f"{root}/proc/self/statm", "rb", buffering=0) as statm:
        resident_pages = int(statm.read(256).split()[1])
    return resident_pages * _PAGE_BYTES / 1e6


def reset_peak(root: Path = _ROOT) -> bool:
    """Reset the peak of `read_peak_mb` to the current resident memory. Returns False if the kernel refuses."""
    with suppress(OSError):
        return bool((root / "proc/self/clear_refs").write_text("5"))
    return False


def read_peak_mb(root: Path = _ROOT) -> float:
    """Return the peak resident memory of this process in MB since its start or since `reset_peak`."""
    return _read_kib_line(root / "proc/self/status", "VmHWM:")


def read_text(path: Path) -> str | None:
    """Read a small file and strip zero bytes, line ends and blanks; None if it cannot be read."""
    try:
        return path.read_text(errors="replace").strip("\0\n ")
    except OSError:
        return None


def _read_kib_line(path: Path, label: str) -> float:
    """Return the number in the line "LABEL 1234 kB" of a file, converted to MB."""
    line = next(line for line in path.read_text().splitlines() if line.startswith(label))
    return int(line.split()[1]) * 1024 / 1e6


def _read_cgroup_limits(name: str, root: Path) -> Iterator[list[str]]:
    """Yield the fields of the limit file `name` (cgroup v2) of this process's cgroup and all of its parents."""
    memberships = (read_text(root / "proc/self/cgroup") or "").splitlines()
    for group in (PurePosixPath(line.removeprefix("0::")) for line in memberships if line.startswith("0::")):
        for level in (group, *group.parents):
            # The root group has no limit files, and not every kernel has every controller.
            words = (read_text(root / "sys/fs/cgroup" / level.relative_to("/") / name) or "max").split()
            if words[0] != "max":
                yield words
