"""edgevpr on 64-bit ARM, without the hardware: `make test-arm64` writes benchmarks/results/test_arm64.md and
test_arm64.json, and ends with code 1 where something is not as on x86-64.

python benchmarks/on_arm64.py [--cache FOLDER]

As root, with Debian's packages debootstrap, qemu-user-static and gcc, it makes a Debian system for aarch64 in a cache
folder, installs the locked wheels and edgevpr's own, and has QEMU run them as a Cortex-A53: the core of the test suite,
whose golden tests hold descriptors, scores and maps to those of x86-64.
"""

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory

import base
import imageio_ffmpeg
from arm64 import userland
from arm64.userland import Arm
from base import REPOSITORY, Row

from edgevpr.core.text import markdown

NAME = "test_arm64"
LOCK = REPOSITORY / "deploy" / "requirements.lock"
TOOLS = ("debootstrap", "gcc", "dpkg-deb")
QEMUS = ("qemu-aarch64-static", "qemu-aarch64")
# What the tests need beside the lock, in the versions of this environment.
FOR_TESTS = ("pytest", "hypothesis", "matplotlib", "onnx", "scipy", "imageio-ffmpeg", "rasterio")
# What runs the code of compiled libraries: NumPy, SciPy, OpenCV, onnxruntime, PyAV, SQLite. All else is pure Python,
# which is the same on every processor, or flies in real time, for which emulation is too slow.
CORE = ("tests/techniques", "tests/runtime/recognise", "tests/frames", "tests/places", "tests/test_tiny.py")
_LIMIT_S = 3600.0  # of a file: most take a minute or two on a machine that does nothing else


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    usual = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "edgevpr-arm64"
    parser.add_argument("--cache", type=Path, default=usual, help=f"where the system is kept ({usual})")
    args = parser.parse_args()
    missing = [tool for tool in TOOLS if not shutil.which(tool)]
    qemu = next(filter(None, map(shutil.which, QEMUS)), None)
    if missing or not qemu or os.geteuid():
        sys.exit("on_arm64: as root, install debootstrap, qemu-user-static and gcc.")
    with TemporaryDirectory(prefix="edgevpr-arm64-") as work:
        print("building an aarch64 system", flush=True)
        arm = build(args.cache.resolve(), qemu, Path(work))
        system = {**base.made_by(), **userland.versions(arm, qemu)}
        for so_far in tests(arm):
            found = {"system": system, "tests": so_far}
            base.write(NAME, found, page(found))
    sys.exit("\n".join(failures(base.read(NAME))) or None)


def build(cache: Path, qemu: str, work: Path) -> Arm:
    """Make what is not in the cache, and edgevpr's wheel."""
    system, tools = cache / userland.RELEASE, [f"{name}=={metadata.version(name)}" for name in FOR_TESTS]
    key = hashlib.sha256(LOCK.read_bytes() + repr(tools).encode()).hexdigest()[:12]
    python, own = system / "usr/bin/python", work / "own"
    arm = Arm(python, cache / key / "locked", cache / key / "tools", own, work, imageio_ffmpeg.get_ffmpeg_exe())
    _made_once(system, userland.make_system)
    userland.make_launcher(system, qemu)
    _made_once(arm.locked, lambda folder: userland.install(folder, "--require-hashes", "-r", str(LOCK)))
    _made_once(arm.tools, lambda folder: userland.install(folder, *tools))
    for program in (arm.locked / "bin").glob("*.py"):  # where an installation has them, and tests look for them
        link = system / "usr/bin" / program.name
        link.unlink(missing_ok=True)
        link.symlink_to(program)
    wheel = ["wheel", "--quiet", "--no-deps", "--no-build-isolation", f"--wheel-dir={work}", str(REPOSITORY)]
    userland.run([sys.executable, "-m", "pip", *wheel])
    userland.install(arm.own, "--no-deps", *map(str, work.glob("edgevpr-*.whl")))
    return arm


def _made_once(folder: Path, make: Callable[[Path], None]) -> None:
    """Make a folder under another name, so that it is there only when it is whole."""
    if folder.exists():
        return
    unfinished = folder.with_name(f"{folder.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.parent.mkdir(parents=True, exist_ok=True)
    make(unfinished)
    unfinished.rename(folder)


def tests(arm: Arm) -> Iterator[Row]:
    """Run the core of the suite, with the wheel in place of the package's source, as many files at a time as there are
    cores. Yield what has been found, file by file. What has passed with the same code before is not run again."""
    code, tree = code_of(REPOSITORY), arm.work / "tree"
    shutil.copytree(
        REPOSITORY, tree, ignore=shutil.ignore_patterns(".*", "__pycache__", "edgevpr", "demo_out", "results")
    )
    before = base.read(NAME).get("tests", {"code": None, "rows": []})
    rows = [row for row in before["rows"] if before["code"] == code and not row["failed"]]
    files, passed = core_files(tree), {row["file"] for row in rows}
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        missing = [file for file in files if file not in passed]
        for done in as_completed([pool.submit(run_tests, arm.python, tree, file, arm.env) for file in missing]):
            rows.append(row := done.result())
            print(f"{row['file']}: {row['passed']} passed, {len(row['failed'])} failed", flush=True)
            yield {"code": code, "files": files, "rows": rows}


def core_files(tree: Path) -> list[str]:
    """List the files of tests, in the order of `CORE`."""
    found = [[tree / name] if (tree / name).is_file() else sorted((tree / name).rglob("test_*.py")) for name in CORE]
    return [str(path.relative_to(tree)) for paths in found for path in paths]


def code_of(tree: Path) -> str:
    """Return a hash of all that decides how the tests end: package, tests, networks and locked versions."""
    read = hashlib.sha256()
    for name in ("edgevpr", *CORE, "models", "deploy"):
        for path in sorted((tree / name).rglob("*") if (tree / name).is_dir() else [tree / name]):
            if path.is_file() and "__pycache__" not in path.parts:
                read.update(str(path.relative_to(tree)).encode() + path.read_bytes())
    return read.hexdigest()[:12]


def run_tests(python: Path, tree: Path, file: str, env: dict[str, str]) -> Row:
    """Run the tests of a file of `tree`: how many passed, the names of those that failed, and those that were skipped
    with the reason. A file that does not end in time, or crashes, counts as one failure."""
    row: Row = {"file": file, "commit": base.commit(), "passed": 0, "failed": [], "skipped": {}}
    start_s = time.monotonic()
    with TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        argv = [str(python), "-m", "pytest", "-p", "no:cacheprovider", f"--basetemp={folder}/tests"]
        try:
            done = subprocess.run(
                [*argv, f"--junitxml={report}", file],
                cwd=tree,
                env=env,
                capture_output=True,
                text=True,
                timeout=_LIMIT_S,
            )
            said = f"{done.stdout[-500:]}{done.stderr[-500:]}"
        except subprocess.TimeoutExpired:
            said = f"not ended after {_LIMIT_S:g} s"
        row["took_s"] = round(time.monotonic() - start_s, 1)
        if not report.exists():
            return row | {"failed": [f"{file} ({said})"]}
        for case in ET.parse(report).iter("testcase"):
            name = f"{case.get('classname')}.{case.get('name')}"
            if (why := case.find("skipped")) is not None:
                row["skipped"][name] = why.get("message", "").replace(f"{tree.parent}/", "")
            elif case.find("failure") is not None or case.find("error") is not None:
                row["failed"].append(name)
            else:
                row["passed"] += 1
    return row


def failures(found: Row) -> list[str]:
    """List the tests that failed."""
    return [f"{each['file']}: {name} failed." for each in found["tests"]["rows"] for name in each["failed"]]


def page(found: Row) -> str:
    """Return the page for people."""
    system, rows = found["system"], found["tests"]["rows"]
    packages = ", ".join(f"{name} {version}" for name, version in system["packages"].items())
    reasons = Counter(why for each in rows for why in each["skipped"].values())
    listed = "\n".join(f"* {count}: {why}" for why, count in reasons.items()) or "* none"
    every, lines = Counter(map(_folder, found["tests"]["files"])), []
    for folder, run in base.groups(rows, lambda row: _folder(row["file"])):
        passed, took_s = (sum(each[key] for each in run) for key in ("passed", "took_s"))
        counts = [sum(len(each[key]) for each in run) for key in ("failed", "skipped")]
        commits = ", ".join(sorted({each["commit"] for each in run}))
        lines.append([folder, f"{len(run)} of {every[folder]}", *map(str, (passed, *counts, round(took_s))), commits])
    return f"""# edgevpr on 64-bit ARM

Made by `make test-arm64` with {system["qemu"]}, emulating a
{system["cpu"]}, on {system["machine"]["cores"]} cores of an {system["machine"]["cpu"]}. The emulated system is Debian
{system["release"]}: Python {system["python"]}, glibc {system["glibc"]}. edgevpr is installed from its wheel, and all
that it needs from deploy/requirements.lock, with hashes: {packages}.

**{" ".join(failures(found)) or "No test failed."}**

{markdown(("tests", "files run", "passed", "failed", "skipped", "s", "commit"), lines)}

Skipped, by the tests themselves:

{listed}

All other tests are of pure Python, which is the same on every processor, or fly in real time, for which emulation is
too slow. Maps and flights of the same pictures were compared once, at commit 9af87a3: of 5 million numbers one bit of
one landmark differed, and every query of both cameras was decided alike, at the same place.

By their names, and by what the libraries in them ask for, all locked wheels of Python 3.10 to 3.13 need a glibc of 2.28
(asked at commit 2a65c97): Debian 10, with a Python of at least 3.10. The first systems whose own Python will do are
Debian 12, Raspberry Pi OS 12 and Ubuntu 22.04.
"""


def _folder(file: str) -> str:
    return next((name for name in CORE if file.startswith(name)), str(Path(file).parent))


if __name__ == "__main__":
    base.run(main)
