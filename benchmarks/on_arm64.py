"""edgevpr on 64-bit ARM, without the hardware: `make test-arm64` writes benchmarks/results/test_arm64.md and
test_arm64.json, and ends with code 1 where something is not as on x86-64.

As root, with Debian's packages debootstrap, qemu-user-static and gcc, it makes a Debian system for aarch64, installs
the locked wheels and edgevpr's own, and has QEMU run them as a Cortex-A53: the core of the test suite, whose golden
tests hold descriptors, scores and maps to those of x86-64.
"""

import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory

import base
import imageio_ffmpeg
from arm64 import userland
from arm64.userland import Arm
from base import REPOSITORY, Row

LOCK = REPOSITORY / "deploy" / "requirements.lock"
TOOLS = ("debootstrap", "gcc", "dpkg-deb")
QEMUS = ("qemu-aarch64-static", "qemu-aarch64")
# What the tests need beside the lock, in the versions of this environment.
FOR_TESTS = ("pytest", "pytest-xdist", "hypothesis", "matplotlib", "onnx", "scipy", "imageio-ffmpeg", "rasterio")
# What runs the code of compiled libraries: NumPy, SciPy, OpenCV, onnxruntime, PyAV, SQLite. All else is pure Python,
# which is the same on every processor, or flies in real time, for which emulation is too slow.
CORE = ("tests/techniques", "tests/runtime/recognise", "tests/frames", "tests/places", "tests/test_tiny.py")

_COLUMNS = {
    "tests": "{part}",
    "passed": "{passed}",
    "failed": "{failed}",
    "skipped": "{skipped}",
    "s": "{took_s:.0f}",
}


def main() -> None:
    missing = [tool for tool in TOOLS if not shutil.which(tool)]
    qemu = next(filter(None, map(shutil.which, QEMUS)), None)
    if missing or not qemu or os.geteuid():
        sys.exit("on_arm64: as root, install debootstrap, qemu-user-static and gcc.")
    with TemporaryDirectory(prefix="edgevpr-arm64-") as work:
        arm = build(qemu, Path(work))
        system = {**base.made_by(), **userland.versions(arm, qemu)}
        tree, without = arm.work / "tree", (".*", "__pycache__", "edgevpr", "demo_out", "results")
        shutil.copytree(REPOSITORY, tree, ignore=shutil.ignore_patterns(*without))  # the wheel is in place of edgevpr
        found = {"system": system, "tests": run_tests(arm.python, tree, arm.env)}
        base.write("test_arm64", found, page(found))
    sys.exit(failures(found))


def build(qemu: str, work: Path) -> Arm:
    """Make the system, and install the locked wheels, those that the tests need, and edgevpr's own."""
    system = work / "system"
    folders = (work / "locked", work / "tools", work / "own", work)
    arm = Arm(system / "usr/bin/python", *folders, imageio_ffmpeg.get_ffmpeg_exe())
    userland.make_system(system)
    userland.make_launcher(system, qemu)
    userland.install(arm.locked, "--require-hashes", "-r", str(LOCK))
    userland.install(arm.tools, *(f"{name}=={metadata.version(name)}" for name in FOR_TESTS))
    for program in (arm.locked / "bin").glob("*.py"):  # where an installation has them, and tests look for them
        (system / "usr/bin" / program.name).symlink_to(program)
    wheel = ["wheel", "--quiet", "--no-deps", "--no-build-isolation", f"--wheel-dir={work}", str(REPOSITORY)]
    userland.run([sys.executable, "-m", "pip", *wheel])
    userland.install(arm.own, "--no-deps", *map(str, work.glob("edgevpr-*.whl")))
    return arm


def run_tests(python: Path, tree: Path, env: dict[str, str], what: Sequence[str] = CORE) -> Row:
    """Run tests of `tree`, as many files at a time as there are cores: by part of `what` how many passed, and their
    seconds; the names of those that failed, and why how many were skipped."""
    with TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        argv = [str(python), "-m", "pytest", "-p", "no:cacheprovider", f"--basetemp={folder}/tests"]
        argv += ["-n", str(len(os.sched_getaffinity(0))), "--dist=loadfile", f"--junitxml={report}", *what]
        subprocess.run(argv, cwd=tree, env=env)
        every = ET.parse(report).iter("testcase")
        cases = {f"{each.get('classname')}.{each.get('name')}": each for each in every}  # a crash is tried again
    rows = {part: dict.fromkeys(("passed", "failed", "skipped", "took_s"), 0) for part in what}
    found: Row = {"commit": base.commit(), "rows": rows, "failed": [], "skipped": Counter()}
    for name, case in cases.items():
        row = rows[next(part for part in what if name.startswith(part.removesuffix(".py").replace("/", ".")))]
        row["took_s"] += float(case.get("time"))
        if (why := case.find("skipped")) is not None:
            row["skipped"] += 1
            found["skipped"][why.get("message", "").replace(f"{tree.parent}/", "")] += 1
        elif case.find("failure") is not None or case.find("error") is not None:
            row["failed"] += 1
            found["failed"].append(name)
        else:
            row["passed"] += 1
    return found


def failures(found: Row) -> str | None:
    """Return which tests failed, None where none did."""
    return ", ".join(found["tests"]["failed"]) + " failed." if found["tests"]["failed"] else None


def page(found: Row) -> str:
    """Return the page for people."""
    system, rows = found["system"], found["tests"]["rows"]
    packages = ", ".join(f"{name} {version}" for name, version in system["packages"].items())
    listed = "\n".join(f"* {count}: {why}" for why, count in found["tests"]["skipped"].items()) or "* none"
    lines = [{"part": part, **row} for part, row in rows.items()]
    return f"""# edgevpr on 64-bit ARM

Made by `make test-arm64` at commit {found["tests"]["commit"]} with {system["qemu"]}, emulating a
{system["cpu"]}, on {system["machine"]["cores"]} cores of an {system["machine"]["cpu"]}. The emulated system is Debian
{system["release"]}: Python {system["python"]}, glibc {system["glibc"]}. edgevpr is installed from its wheel, and all
that it needs from deploy/requirements.lock, with hashes: {packages}.

**{failures(found) or "No test failed."}**

{base.table(lines, _COLUMNS)}

Skipped, by the tests themselves:

{listed}

All other tests are of pure Python, which is the same on every processor, or fly in real time, for which emulation is
too slow. Maps and flights of the same pictures were compared once, at commit 9af87a3: of 5 million numbers one bit of
one landmark differed, and every query of both cameras was decided alike, at the same place.

By their names, and by what the libraries in them ask for, all locked wheels of Python 3.10 to 3.13 need a glibc of 2.28
(asked at commit 2a65c97): Debian 10, with a Python of at least 3.10. The first systems whose own Python will do are
Debian 12, Raspberry Pi OS 12 and Ubuntu 22.04.
"""


if __name__ == "__main__":
    base.run(main)
