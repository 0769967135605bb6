"""What a query costs an ARM core: the instructions of its parts, counted while an emulated Cortex-A53 runs them.
`make bench-arm64` writes benchmarks/results/arm64.md and arm64.json, and the counts that `edgevpr profile` estimates
ARM boards by.

It needs Debian's packages qemu-user, debootstrap and gcc, and the registries of Debian and PyPI. Counts repeat to some
thousandths; times do not.
"""

import json
import os
import shutil
import sys
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import base
from arm64 import counted
from arm64.userland import CPU, PYTHON, install, make_system, run
from big_map import make_big_map

from edgevpr.power.boards import load_board
from edgevpr.runtime.preflight.scale import COUNTED_PATH
from edgevpr.techniques import create

HERE = Path(__file__).resolve().parent
TOOLS = ("qemu-aarch64", "debootstrap", "gcc", "dpkg-deb")
WHEELS = ("numpy", "opencv-python-headless", "psutil", "pyyaml", "pymavlink", "fastcrc")  # what the parts import
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
        build(work)
        maps = [str(work / f"{camera}.gpkg") for camera in ("forward", "nadir")]
        for path in maps:
            make_big_map(Path(path), create("cohog", {"camera": Path(path).stem}).spec, counted.LARGE)
        rows = count(work, maps)
    found = {**base.made_by(), "parts": rows}
    figures = counted.figures({row["part"]: row["instructions"] for row in rows})
    COUNTED_PATH.write_text(json.dumps(figures, indent=1) + "\n")
    base.write("arm64", found, page(found))


def build(work: Path) -> None:
    """Make a Debian system for aarch64 with Python, the wheels that edgevpr imports, and the plug-in that counts."""
    make_system(work / "system")
    install(work / "site", "--no-deps", *(f"{name}=={metadata.version(name)}" for name in WHEELS))
    run(["gcc", "-shared", "-fPIC", "-O2", "-o", str(work / "count.so"), str(HERE / "arm64" / "count.c")])


def count(work: Path, maps: list[str]) -> list[dict[str, Any]]:
    """Run the parts under emulation. Returns for each its name (`part`) and its `instructions`."""
    argv = ["qemu-aarch64", "-cpu", CPU, "-L", str(work / "system"), "-plugin", str(work / "count.so")]
    argv += [str(work / f"system/usr/bin/python{PYTHON}"), str(HERE / "arm64" / "work.py"), *maps]
    done = run(argv, {"PYTHONPATH": f"{work / 'site'}:{HERE.parent}"})
    marks = [int(line) for line in done.stderr.splitlines() if line.isdigit()]
    names = done.stdout.splitlines()
    if len(marks) != 2 * len(names):
        raise RuntimeError(f"{len(marks)} marks of {len(names)} parts: {done.stderr}")
    counted_of = zip(names, marks[::2], marks[1::2], strict=True)
    return [{"part": name, "instructions": after - before} for name, before, after in counted_of]


def page(found: dict[str, Any]) -> str:
    """Return the page for people."""
    machine, mips = found["machine"], load_board("rpi-zero-2w").benchmark_score.arm64_mips
    millions = {row["part"]: row["instructions"] / 1e6 for row in found["parts"]}
    rows = [{"part": part, "millions": each, "zero_s": each / mips} for part, each in millions.items()]
    return f"""# What a query costs an ARM core

Made by `make bench-arm64` on {found["date"]}, commit {found["commit"]}: {counted.LARGE} places, and a picture in which
nearly every region is good. Counted while QEMU ran a Cortex-A53, with NumPy {machine["numpy"]} and OpenCV
{machine["opencv"]} for aarch64. The last column divides by the {mips:g} million instructions a second of
`profiles/rpi-zero-2w.yaml`.

{base.table(rows, _COLUMNS)}
"""


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
