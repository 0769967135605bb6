"""edgevpr on 64-bit ARM, without the hardware: `make test-arm64` writes benchmarks/results/test_arm64.md and
test_arm64.json, and ends with code 1 where something is not as on x86-64.

python benchmarks/on_arm64.py [--parts A,B] [--cache FOLDER]

As root, with Debian's packages debootstrap, qemu-user-static and gcc, it makes a Debian system for aarch64 in a cache
folder, installs the locked wheels and edgevpr's own, and has QEMU run them as a Cortex-A53: the core of the test suite,
and the same flights as on this machine.
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
from typing import Any

import base
import imageio_ffmpeg
from arm64 import compare, userland
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
_TESTS = ("folder", "files run", "passed", "failed", "skipped", "s", "commit")
SEED = 1  # of the ground that is flown over
_LIMIT_S = 3600.0  # of a file: most take a minute or two on a machine that does nothing else
_FLIGHTS = {
    "": "{camera}, map made on {map_made_on}",
    "queries": "{queries}",
    "accepted": "{accepted}",
    "other decision": "{other_decision}",
    "other place accepted": "{other_place}",
    "other place refused by both": "{other_refused}",
    "other words": "{other_words}",
    "score": "{score:.1e}",
    "confidence": "{confidence:.1e}",
    "located, mm": "{located_mm:.4f}",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", metavar="A,B", default=",".join(PARTS), help=f"some of {', '.join(PARTS)}")
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
        for name in args.parts.split(","):
            print(f"trying: {name}", flush=True)
            for so_far in PARTS[name](arm):
                found = {**base.read(NAME), "system": system, name: so_far}
                found.setdefault("made", {})[name] = {key: system[key] for key in ("date", "commit")}
                base.write(NAME, found, page(found))
    sys.exit("\n".join(wrongs(base.read(NAME))) or None)


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


def flights(arm: Arm) -> Iterator[Row]:
    """Make maps of the same pictures on both processors, and fly over both maps with each. Yield what has been found,
    camera by camera."""

    def here(*arguments: object) -> str:
        return userland.run(
            [sys.executable, "-m", "edgevpr", *map(str, arguments)], {"PYTHONPATH": str(REPOSITORY)}
        ).stdout

    found: Row = {"every": compare.EVERY, "maps": [], "flights": []}
    pictures = compare.make_pictures(arm.work, SEED, here)
    for camera in compare.CAMERAS:
        maps, flown = compare.compared(arm.work, pictures, camera, here, arm.edgevpr)
        found["maps"] += maps
        found["flights"] += flown
        print(flown, flush=True)
        yield found


PARTS = {"flights": flights, "tests": tests}


def wrongs(found: Row) -> list[str]:
    """List what is not as on x86-64, a sentence each."""
    tried = found.get("tests", {"rows": []})["rows"]
    said = [f"{each['file']}: {name} failed." for each in tried for name in each["failed"]]
    return said + compare.wrongs(found.get("flights", {"maps": [], "flights": []}))


def page(found: Row) -> str:
    """Return the page for people."""
    system = found["system"]
    packages = ", ".join(f"{name} {version}" for name, version in system["packages"].items())
    tried = ", ".join(
        f"{name} ({found['made'][name]['date']}, commit {found['made'][name]['commit']})" for name in PARTS
    )
    judged = wrongs(found) or ["Nothing differs in what was tried."]
    judged += [f"Not tried: {name}." for name in PARTS if name not in found]
    return f"""# edgevpr on 64-bit ARM

Made by `make test-arm64` with {system["qemu"]}, emulating a
{system["cpu"]}, on {system["machine"]["cores"]} cores of an {system["machine"]["cpu"]}. The emulated system is Debian
{system["release"]}: Python {system["python"]}, glibc {system["glibc"]}. edgevpr is installed from its wheel, and all
that it needs from deploy/requirements.lock, with hashes: {packages}.
Tried: {tried}.

**{" ".join(judged)}**

## The oldest system

By their names, and by what the libraries in them ask for, all locked wheels of Python 3.10 to 3.13 need a glibc of 2.28
(asked at commit 2a65c97): Debian 10, with a Python of at least 3.10. The first systems whose own Python will do are
Debian 12, Raspberry Pi OS 12 and Ubuntu 22.04.

{_flights(found["flights"]) if "flights" in found else ""}

{_tests(found["tests"]) if "tests" in found else ""}
"""


def _flights(found: Row) -> str:
    parts = {"": "{camera}: {part}", "numbers": "{numbers}", "differ": "{differ}", "most": "{most}"}
    return f"""## The same pictures on both

A map of the same 70 pictures made on each: numbers of all places, how many differ, and by how much at most (of
landmarks, which are bits, 2^n is one bit).

{base.table(found["maps"], parts)}

Flights of the same pictures (one of {found["every"]} of the flight) over each map, here and there: how often something
else was decided or told, and the largest differences of score, confidence and accepted position. Decisions are the same
where each query is accepted by both or by none, with the same place and position. Which place a query found that both
refuse is no decision: it is counted apart.

{base.table(found["flights"], _FLIGHTS)}"""


def _tests(found: Row) -> str:
    rows, reasons = [], Counter(why for each in found["rows"] for why in each["skipped"].values())
    every = Counter(map(_folder, found["files"]))
    for folder, run in base.groups(found["rows"], lambda row: _folder(row["file"])):
        counts: dict[str, Any] = {key: sum(len(each[key]) for each in run) for key in ("failed", "skipped")}
        counts |= {
            "folder": folder,
            "files run": f"{len(run)} of {every[folder]}",
            "s": round(sum(r["took_s"] for r in run)),
        }
        commits = ", ".join(sorted({each["commit"] for each in run}))
        rows.append(counts | {"passed": sum(each["passed"] for each in run), "commit": commits})
    listed = "\n".join(f"* {count}: {why}" for why, count in reasons.items()) or "* none"
    return f"""## Tests

{markdown(list(_TESTS), [[str(row[key]) for key in _TESTS] for row in rows])}

Skipped, by the tests themselves:

{listed}

All other tests are of pure Python, which is the same on every processor, or fly in real time, for which emulation is
too slow."""


def _folder(file: str) -> str:
    return next((name for name in CORE if file.startswith(name)), str(Path(file).parent))


if __name__ == "__main__":
    base.run(main)
