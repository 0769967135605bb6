"""What a query costs an ARM core: the instructions of its parts, counted while an emulated Cortex-A53 runs them.
`make bench-arm64` writes benchmarks/results/arm64.md and arm64.json, and the counts that `edgevpr profile` estimates
ARM boards by.

It needs Debian's packages qemu-user, debootstrap and gcc, and the registries of Debian and PyPI. Counts repeat to some
thousandths; times do not. Only the program is emulated: its system calls are this machine's, and so are its files but
for those of the Debian system that is made for it.
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
from edgevpr.runtime.preflight.instructions import COUNTED_PATH
from edgevpr.techniques import create

HERE = Path(__file__).resolve().parent
TOOLS = ("qemu-aarch64", "debootstrap", "gcc", "dpkg-deb")
WHEELS = ("numpy", "opencv-python-headless", "psutil", "pyyaml")  # what the parts import
RELEASE = "bookworm"  # glibc 2.36, Python 3.11: that of Raspberry Pi OS 12
PYTHON = "3.11"
EMULATED_CPU = "cortex-a53"  # an instruction that a Raspberry Pi 3 or Zero 2 W has not ends the program
# As Linux tells it of a Raspberry Pi Zero 2 W.
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
_GLIBC = ("2_17", "2_24", "2_26", "2_27", "2_28")  # of the wheels
_COLUMNS = {
    "part": "{part}",
    "million instructions": "{millions:.2f}",
    "s on Zero 2 W": "{zero_s:.3f}",
}


def main() -> None:
    missing = [tool for tool in TOOLS if not shutil.which(tool)]
    if missing or os.geteuid():
        sys.exit(f"bench_arm64: as root, install qemu-user, debootstrap and gcc ({' '.join(missing)} is not there).")
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
    """Make a Debian system for aarch64 with Python, the wheels that edgevpr imports, and the plug-in that counts."""
    make_system(work / "system")
    names = [*(f"manylinux_{version}" for version in _GLIBC), "manylinux2014"]
    tags = ["--only-binary=:all:", "--implementation=cp", f"--python-version={PYTHON}"]
    tags += [f"--platform={name}_aarch64" for name in names]
    wheels = [f"{name}=={metadata.version(name)}" for name in WHEELS]
    pip = [sys.executable, "-m", "pip", "install", "--quiet", f"--target={work / 'site'}", "--no-deps"]
    run_command([*pip, *tags, *wheels])
    run_command(["gcc", "-shared", "-fPIC", "-O2", "-o", str(work / "count.so"), str(HERE / "arm64" / "count.c")])


def make_system(folder: Path) -> None:
    """Make a Debian system for aarch64 with Python in a new folder, from Debian's packages; needs root for that."""
    packages = "python3,libsqlite3-0,libstdc++6"
    run_command(
        ["debootstrap", "--foreign", "--arch=arm64", "--variant=minbase", f"--include={packages}", RELEASE, str(folder)]
    )
    for archive in sorted((folder / "var/cache/apt/archives").glob("*.deb")):
        run_command(["dpkg-deb", "-x", str(archive), str(folder)])
        archive.unlink()
    # QEMU looks for every path here first: devices and settings are to be this machine's.
    for path in folder.iterdir():
        if path.name not in ("usr", "lib", "bin", "sbin"):
            shutil.rmtree(path)
    # Libraries look here for what the processor can do: not that of this machine.
    (folder / "proc").mkdir()
    (folder / "proc/cpuinfo").write_text("\n".join(_CPUINFO.format(number) for number in range(4)))


def run_command(argv: Sequence[str], env: Mapping[str, str] | None = None) -> subprocess.CompletedProcess:
    """Run a command, with `env` beside the variables of this process; one that fails ends the program with its
    output."""
    done = subprocess.run(argv, capture_output=True, text=True, env={**os.environ, **(env or {})})
    if done.returncode:
        sys.exit(f"{' '.join(argv[:4])} ... failed: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done


def count_instructions(work: Path, maps: list[str]) -> list[dict[str, Any]]:
    """Run the parts under emulation. Returns for each its name (`part`) and its `instructions`."""
    argv = ["qemu-aarch64", "-cpu", EMULATED_CPU, "-L", str(work / "system"), "-plugin", str(work / "count.so")]
    argv += [str(work / f"system/usr/bin/python{PYTHON}"), str(HERE / "arm64" / "work.py"), *maps]
    done = run_command(argv, {"PYTHONPATH": f"{work / 'site'}:{HERE.parent}"})
    marks = [int(line) for line in done.stderr.splitlines() if line.isdigit()]
    names = done.stdout.splitlines()
    if len(marks) != 2 * len(names):
        raise RuntimeError(f"{len(marks)} marks of {len(names)} parts: {done.stderr}")
    parts = zip(names, marks[::2], marks[1::2], strict=True)
    return [{"part": name, "instructions": after - before} for name, before, after in parts]


def format_page(result: dict[str, Any]) -> str:
    """Return the page for people."""
    machine, places = result["machine"], counted.LARGE_MAP_PLACES
    mips = load_board("rpi-zero-2w").benchmark_score.arm64_mips
    millions = {row["part"]: row["instructions"] / 1e6 for row in result["parts"]}
    rows = [{"part": part, "millions": count, "zero_s": count / mips} for part, count in millions.items()]
    return f"""# What a query costs an ARM core

Made by `make bench-arm64` on {result["date"]}, commit {result["commit"]}: {places} places, and a picture in which
nearly every region is good. Counted while QEMU ran a Cortex-A53, with NumPy {machine["numpy"]} and OpenCV
{machine["opencv"]} for aarch64. The last column divides by the {mips:g} million instructions a second of
`profiles/rpi-zero-2w.yaml`.

{base.format_table(rows, _COLUMNS)}
"""


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
