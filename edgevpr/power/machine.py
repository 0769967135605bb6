"""Hardware of this machine and memory of this process, as the kernel reports them in /proc and /sys.

Board profiles, power meters and trials of techniques use it. `root` is the root of the file system: another tree can
stand in. A megabyte (MB) is 10^6 bytes.
"""

import os
import platform
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath

_ROOT = Path("/")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
# Arm's part numbers in /proc/cpuinfo (implementer 0x41), of processors that companion computers have.
_ARM_PARTS = {
    "0xc07": "Cortex-A7", "0xc0f": "Cortex-A15", "0xd03": "Cortex-A53", "0xd04": "Cortex-A35", "0xd05": "Cortex-A55",
    "0xd07": "Cortex-A57", "0xd08": "Cortex-A72", "0xd09": "Cortex-A73", "0xd0a": "Cortex-A75", "0xd0b": "Cortex-A76",
    "0xd0d": "Cortex-A77", "0xd41": "Cortex-A78", "0xd42": "Cortex-A78AE", "0xd46": "Cortex-A510",
}  # fmt: skip


def model(root: Path = _ROOT) -> str | None:
    """Return the board's name in the device tree, e.g. "Raspberry Pi 4 Model B Rev 1.4"; None without one (x86)."""
    return text(root / "proc/device-tree/model")


def dmi_model(root: Path = _ROOT) -> str | None:
    """Return maker and product from the firmware (DMI) of an x86 machine; None if it says neither."""
    names = (text(root / "sys/class/dmi/id" / name) for name in ("sys_vendor", "product_name"))
    return " ".join(filter(None, names)) or None


def cpu(root: Path = _ROOT) -> str:
    """Return the processor's name from /proc/cpuinfo: the model (x86, 32-bit ARM), or the number and name of each kind
    of Arm core, e.g. "4 x Cortex-A72"."""
    info = text(root / "proc/cpuinfo") or ""
    if name := re.search(r"^model name\s*:\s*(.+)$", info, re.MULTILINE):
        return " ".join(name[1].split())
    parts = Counter(re.findall(r"^CPU part\s*:\s*(\w+)$", info, re.MULTILINE))
    kinds = [f"{count} x {_ARM_PARTS.get(part, f'CPU part {part}')}" for part, count in parts.items()]
    return " + ".join(kinds) or f"unknown {platform.machine()} processor"


def title(root: Path = _ROOT) -> str:
    """Return the machine's name and processor as one text, the same at every start, so that it identifies the
    machine."""
    words = f"{model(root) or dmi_model(root) or 'a machine without a name'} ({cpu(root)})"
    return "".join(c if c.isprintable() else " " for c in words)


def cores_online(root: Path = _ROOT) -> int:
    """Count the cores of the machine that are switched on, including those that this process may not use."""
    spans = re.findall(r"(\d+)(?:-(\d+))?", text(root / "sys/devices/system/cpu/online") or "")
    return sum(int(last or first) - int(first) + 1 for first, last in spans) or os.cpu_count() or 1


def cores(root: Path = _ROOT) -> float:
    """Return how many cores this process may use, by CPU affinity and the quotas (cpu.max) of its control groups."""
    quotas = (int(quota_us) / int(period_us) for quota_us, period_us in _cgroup_limits("cpu.max", root))
    return min([float(len(os.sched_getaffinity(0))), *quotas])


def ram_mb(root: Path = _ROOT) -> float:
    """Return the RAM of the machine in MB."""
    return _kib_line(root / "proc/meminfo", "MemTotal:")


def ram_limit_mb(root: Path = _ROOT) -> float:
    """Return the RAM in MB that this process may use: the machine's, or the lowest limit (memory.max) of its control
    groups."""
    return min([ram_mb(root), *(int(limit) / 1e6 for (limit,) in _cgroup_limits("memory.max", root))])


def rss_mb(root: Path = _ROOT) -> float:
    """Return the resident memory (RSS) of this process in MB, including pages that it shares with other processes."""
    # Called twice per query: `read_text` would take three times as long.
    with open(f"{root}/proc/self/statm", "rb", buffering=0) as statm:
        resident_pages = int(statm.read(256).split()[1])
    return resident_pages * _PAGE_BYTES / 1e6


def forget_peak(root: Path = _ROOT) -> bool:
    """Reset the peak that `peak_mb` returns to what is resident now. Returns False if the kernel does not allow it."""
    with suppress(OSError):
        return bool((root / "proc/self/clear_refs").write_text("5"))
    return False


def peak_mb(root: Path = _ROOT) -> float:
    """Return the largest resident memory that this process has had, in MB, since it started or since `forget_peak`."""
    return _kib_line(root / "proc/self/status", "VmHWM:")


def pss_mb(root: Path = _ROOT) -> float | None:
    """Return the memory of this process in MB, with shared pages in proportion (PSS); None if the kernel gives none."""
    with suppress(OSError):
        return _kib_line(root / "proc/self/smaps_rollup", "Pss:")
    return None


def text(path: Path) -> str | None:
    """Read a small file and strip zero bytes, line ends and blanks from both ends; None if it cannot be read."""
    try:
        return path.read_text(errors="replace").strip("\0\n ")
    except OSError:
        return None


def _kib_line(path: Path, label: str) -> float:
    """Return the number of the line "LABEL 1234 kB" of a file, converted to MB."""
    line = next(line for line in path.read_text().splitlines() if line.startswith(label))
    return int(line.split()[1]) * 1024 / 1e6


def _cgroup_limits(name: str, root: Path) -> Iterator[list[str]]:
    """Yield the fields of the limit file `name` (cgroup v2) of this process's control group and all above it."""
    memberships = (text(root / "proc/self/cgroup") or "").splitlines()
    for group in (PurePosixPath(line.removeprefix("0::")) for line in memberships if line.startswith("0::")):
        for level in (group, *group.parents):
            # The root group has no limit files, and not every kernel has every controller.
            words = (text(root / "sys/fs/cgroup" / level.relative_to("/") / name) or "max").split()
            if words[0] != "max":
                yield words
