"""Count the instructions that each part of a query takes on an ARM core, an emulated Cortex-A53. `make bench-arm64`
writes benchmarks/results/arm64.md and arm64.json, and the counts from which `edgevpr profile` estimates ARM boards.

Needs Debian's packages qemu-user, debootstrap and gcc, and access to the registries of Debian and PyPI. Counts repeat
within a few thousandths; times do not. Only the program is emulated: it uses this machine's system calls, and its files
except those of the Debian system that is made for it.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import base
from arm64 import counted
from big_map import make_big_map

from edgevpr.power.boards import load_board
from edgevpr.runtime.preflight.estimate import COUNTED_PATH
from edgevpr.techniques import create

HERE = Path(__file__).resolve().parent
TOOLS = ("qemu-aarch64", "debootstrap", "gcc", "dpkg-deb")
WHEELS = ("numpy", "opencv-python-headless", "psutil", "pyyaml")  # that the parts of the query import
RELEASE = "bookworm"  # glibc 2.36, Python 3.11: that of Raspberry Pi OS 12
PYTHON = "3.11"
EMULATED_CPU = "cortex-a53"  # an instruction that a Raspberry Pi 3 or Zero 2 W lacks ends the program
# A core in /proc/cpuinfo of a Raspberry Pi Zero 2 W.
_CPUINFO = """\
processor\t: {}
BogoMIPS\t: 38.40
Features\t: fp asimd evtstrm crc32 cpuid
CPU implementer\t: 0x41
CPU architecture: 8
CPU variant\t: 0x0
CPU part\t: 0xd03
CPU revision\t: 4
"""
_GLIBC = ("2_17", "2_24", "2_26", "2_27", "2_28")  # versions that wheels are built for
_COLUMNS = {"part": "{part}", "million instructions": "{millions:.2f}", "s on Zero 2 W": "{zero_s:.3f}"}


def main() -> None:
    missing = [tool for tool in TOOLS if not shutil.which(tool)]
    if missing or os.geteuid():
        lacks = ", ".join(missing) or "no tool"
        sys.exit(f"bench_arm64: run as root, with qemu-user, debootstrap and gcc installed (missing: {lacks}).")
    with TemporaryDirectory(prefix="edgevpr-arm64-") as folder:
        work = Path(folder)
        build_tools(work)
        maps = [str(work / f"{camera}.gpkg") for camera in ("forward", "nadir")]
        for path in maps:
            make_big_map(Path(path), create("cohog", {"camera": Path(path).stem}).spec, counted.LARGE_MAP_PLACES)
        rows = count_instructions(work, maps)
    result = {**base.describe_run(), "parts": rows}
    figures = counted.compute_counts({row["part"]: row["instructions"] for row in rows})
    COUNTED_PATH.write_text(json.dumps(figures, indent=1) + "\n")
    base.write("arm64", result, format_page(result))


def build_tools(work: Path) -> None:
    """Make a Debian system for aarch64 with Python, the wheels that edgevpr imports, and the counting plug-in."""
    make_system(work / "system")
    names = [*(f"manylinux_{version}" for version in _GLIBC), "manylinux2014"]
    tags = ["--only-binary=:all:", "--implementation=cp", f"--python-version={PYTHON}"]
    tags += [f"--platform={name}_aarch64" for name in names]
    wheels = [f"{name}=={metadata.version(name)}" for name in WHEELS]
    pip = [sys.executable, "-m", "pip", "install", "--quiet", f"--target={work / 'site'}", "--no-deps"]
    run_command([*pip, *tags, *wheels])
    run_command(["gcc", "-shared", "-fPIC", "-O2", "-o", str(work / "count.so"), str(HERE / "arm64" / "count.c")])


def make_system(folder: Path) -> None:
    """Make a Debian system for aarch64 with Python in a new folder, from Debian's packages (needs root)."""
    packages = "python3,libsqlite3-0,libstdc++6"
    run_command(
        ["debootstrap", "--foreign", "--arch=arm64", "--variant=minbase", f"--include={packages}", RELEASE, str(folder)]
    )
    for archive in sorted((folder / "var/cache/apt/archives").glob("*.deb")):
        run_command(["dpkg-deb", "-x", str(archive), str(folder)])
        archive.unlink()
    # QEMU looks up every path here first. Without these folders it finds this machine's devices and settings.
    for path in folder.iterdir():
        if path.name not in ("usr", "lib", "bin", "sbin"):
            shutil.rmtree(path)
    # Libraries read the features of the processor here: give them the emulated processor's.
    (folder / "proc").mkdir()
    (folder / "proc/cpuinfo").write_text("\n".join(_CPUINFO.format(number) for number in range(4)))


def run_command(argv: Sequence[str], env: Mapping[str, str] | None = None) -> subprocess.CompletedProcess:
    """Run a command with `env` added to the environment. If it fails, exit with the end of its output."""
    process = subprocess.run(argv, capture_output=True, text=True, env={**os.environ, **(env or {})})
    if process.returncode:
        sys.exit(f"{' '.join(argv[:4])} ... failed: {process.stdout[-2000:]}{process.stderr[-2000:]}")
    return process


def count_instructions(work: Path, maps: list[str]) -> list[dict[str, Any]]:
    """Run the parts under emulation, and return the name (`part`) and the number of `instructions` of each."""
    argv = ["qemu-aarch64", "-cpu", EMULATED_CPU, "-L", str(work / "system"), "-plugin", str(work / "count.so")]
    argv += [str(work / f"system/usr/bin/python{PYTHON}"), str(HERE / "arm64" / "work.py"), *maps]
    process = run_command(argv, {"PYTHONPATH": f"{work / 'site'}:{HERE.parent}"})
    counts = [int(line) for line in process.stderr.splitlines() if line.isdigit()]  # before and after each part
    names = process.stdout.splitlines()
    if len(counts) != 2 * len(names):
        raise RuntimeError(f"{len(counts)} counts for {len(names)} parts (two each expected): {process.stderr}")
    parts = zip(names, counts[::2], counts[1::2], strict=True)
    return [{"part": name, "instructions": after - before} for name, before, after in parts]


def format_page(result: dict[str, Any]) -> str:
    """Return the results as Markdown."""
    machine, places = result["machine"], counted.LARGE_MAP_PLACES
    mips = load_board("rpi-zero-2w").benchmark_score.arm64_mips
    millions = {row["part"]: row["instructions"] / 1e6 for row in result["parts"]}
    rows = [{"part": part, "millions": count, "zero_s": count / mips} for part, count in millions.items()]
    return f"""# What a query costs an ARM core

Made by `make bench-arm64` on {result["date"]}, commit {result["commit"]}, with a map of {places} places and a
picture whose regions are nearly all used. Instructions were counted while QEMU emulated a Cortex-A53, with NumPy
{machine["numpy"]} and OpenCV {machine["opencv"]} for aarch64. The last column divides them by the {mips:g} million
instructions per second of `profiles/rpi-zero-2w.yaml`.

{base.format_table(rows, _COLUMNS)}
"""


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
