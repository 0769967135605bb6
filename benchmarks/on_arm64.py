"""edgevpr on 64-bit ARM, without the hardware: `make test-arm64` writes benchmarks/results/test_arm64.md and
test_arm64.json, and ends with code 1 where something is not as on x86-64.

python benchmarks/on_arm64.py [--parts A,B] [--cache FOLDER]

As root, with Debian's packages debootstrap, qemu-user-static and gcc, it makes a Debian system for aarch64 in a cache
folder, installs the locked wheels and edgevpr's own, and has QEMU run them as a Cortex-A53: the core of the test suite,
the demonstration, and the same flights as on this machine.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import argparse
import hashlib
import json
import shutil
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import imageio_ffmpeg
from arm64 import compare, glibc, suite, userland
from arm64.page import page, wrongs
from run_sets import commit_of, made_by

REPOSITORY = Path(__file__).resolve().parents[1]
KEPT = REPOSITORY / "benchmarks" / "results" / "test_arm64.json"  # and the page beside it
LOCK = REPOSITORY / "deploy" / "requirements.lock"
TOOLS = ("debootstrap", "gcc", "dpkg-deb")
QEMUS = ("qemu-aarch64-static", "qemu-aarch64")
# What the tests and the demonstration need beside the lock, in the versions of this environment.
FOR_TESTS = ("pytest", "matplotlib", "onnx", "scipy", "imageio-ffmpeg", "rasterio")
MACHINES, PYTHONS = ("aarch64", "x86_64"), ("3.10", "3.11", "3.12", "3.13")
SEED = 1  # of the ground that is flown over
# A part of it: of five legs one is mapped, and of the flight every second picture over it and some far from it are
# asked for. A query of a small map takes little time, so that under emulation a frame need not be too old for a fix.
_DEMO = """
import json, re, sys
from collections import Counter
from dataclasses import asdict, replace
from edgevpr.runtime.flight.wholeflight import flight_of
from edgevpr.lab.simulate import demo
def part_of(plan, *parts):
    return lambda seed: replace(plan(seed), poses=sum((plan(seed).poses[part] for part in parts), ()))
demo.mapping_flight = part_of(demo.mapping_flight, slice(42, 56))
demo.later_flight = part_of(demo.later_flight, slice(0, 14, 2), slice(32, 38, 2))
done = demo.run_demo(sys.argv[1])
lines = list(flight_of(f"{sys.argv[1]}/flight.jsonl"))
told = [line.get("fix") or line for line in lines if line["kind"] in ("query", "answer")]
whys = Counter(re.sub("is [0-9.]+ s old", "is too old", each["why"]) for each in told if each.get("sent") is False)
print(json.dumps({**asdict(done.outcome), "places": done.places, "messages_heard": sum(done.messages.values()),
    "fixes_accepted": done.fixes_accepted, "fixes_denied": done.fixes_denied, "used_mah": done.used_mah,
    "wall_s": done.wall_s, "not_sent": whys}))
"""


@dataclass(frozen=True, slots=True)
class Arm:
    """The emulated Python, the folders of its wheels (the lock's, the tests', edgevpr's own), and a folder to work
    in."""

    python: Path
    locked: Path
    tools: Path
    own: Path
    work: Path

    @property
    def env(self) -> dict[str, str]:
        """The variables of a program that uses all of them."""
        paths = os.pathsep.join(map(str, (self.own, self.locked, self.tools)))
        # FFmpeg itself only makes films for tests: this machine's will do.
        return {**os.environ, "PYTHONPATH": paths, "IMAGEIO_FFMPEG_EXE": imageio_ffmpeg.get_ffmpeg_exe()}

    def edgevpr(self, *arguments: object) -> str:
        """Run edgevpr under emulation; return what it prints."""
        return userland.run([str(self.python), "-m", "edgevpr", *map(str, arguments)], self.env).stdout


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
        system = {**made_by(), **versions(arm, qemu)}
        for name in args.parts.split(","):
            print(f"trying: {name}", flush=True)
            for so_far in PARTS[name](arm):
                keep(name, so_far, system)
    found = kept()
    print(page(found))
    sys.exit("\n".join(wrongs(found)) or None)


def keep(name: str, found: Any, system: dict[str, Any]) -> None:
    """Write a part as it has been found so far, beside the others, which may have been written since."""
    everything = {**kept(), "system": system, name: found}
    everything.setdefault("made", {})[name] = {key: system[key] for key in ("date", "commit")}
    KEPT.write_text(json.dumps(everything, indent=1) + "\n")
    KEPT.with_suffix(".md").write_text(page(everything))


def kept() -> dict[str, Any]:
    """Return what has been found so far."""
    return json.loads(KEPT.read_text()) if KEPT.exists() else {}


def build(cache: Path, qemu: str, work: Path) -> Arm:
    """Make what is not in the cache, and edgevpr's wheel."""
    system, tools = cache / userland.RELEASE, metadata_of(FOR_TESTS)
    key = hashlib.sha256(LOCK.read_bytes() + repr(sorted(tools.items())).encode()).hexdigest()[:12]
    arm = Arm(
        python=system / "usr/bin/python",
        locked=cache / key / "locked",
        tools=cache / key / "tools",
        own=work / "own",
        work=work,
    )
    _made_once(system, userland.make_system)
    userland.make_launcher(system, qemu)
    _made_once(arm.locked, lambda folder: userland.install(folder, "--require-hashes", "-r", str(LOCK)))
    _made_once(arm.tools, lambda folder: userland.install(folder, *(f"{name}=={each}" for name, each in tools.items())))
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


def metadata_of(names: tuple[str, ...]) -> dict[str, str]:
    """Return the versions of packages of this environment."""
    return {name: metadata.version(name) for name in names}


def versions(arm: Arm, qemu: str) -> dict[str, Any]:
    """Return what the emulated system is made of."""
    asked = "import platform; print(platform.machine(), platform.python_version(), platform.libc_ver()[1])"
    machine, python, libc = userland.run([str(arm.python), "-c", asked], arm.env).stdout.split()
    packages = {each.metadata["Name"]: each.version for each in metadata.distributions(path=[str(arm.locked)])}
    return {
        "processor": machine,
        "cpu": userland.CPU,
        "qemu": userland.run([qemu, "--version"]).stdout.split("\n")[0],
        "release": userland.RELEASE,
        "python": python,
        "glibc": libc,
        "packages": dict(sorted(packages.items())),
    }


def tests(arm: Arm) -> Iterator[dict[str, Any]]:
    """Run the core of the suite, with the wheel in place of the package's source, as many files at a time as there are
    cores. Yield what has been found, file by file. What has passed with the same code before is not run again."""
    code, commit = suite.code_of(REPOSITORY), commit_of()
    tree = arm.work / "tree"
    beside = shutil.ignore_patterns(".*", "__pycache__", "edgevpr", "demo_out", "results")
    shutil.copytree(REPOSITORY, tree, ignore=beside)
    before = kept().get("tests", {"code": None, "rows": []})
    rows = [row for row in before["rows"] if before["code"] == code and not row["failed"]]
    files, passed = suite.files(tree), {row["file"] for row in rows}
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        running = [
            pool.submit(suite.run_tests, arm.python, tree, file, arm.env, commit)
            for file in files
            if file not in passed
        ]
        for done in as_completed(running):
            rows.append(asdict(row := done.result()))
            print(f"{row.file}: {row.passed} passed, {len(row.failed)} failed", flush=True)
            yield {"code": code, "files": files, "rows": rows}


def demo(arm: Arm) -> Iterator[dict[str, Any]]:
    """Run the demonstration on both processors."""
    there = userland.run([str(arm.python), "-c", _DEMO, str(arm.work / "demo-arm")], arm.env)
    here = userland.run([sys.executable, "-c", _DEMO, str(arm.work / "demo-here")], {"PYTHONPATH": str(REPOSITORY)})
    yield {"aarch64": json.loads(there.stdout), "x86-64": json.loads(here.stdout)}


def flights(arm: Arm) -> Iterator[dict[str, Any]]:
    """Make maps of the same pictures on both processors, and fly over both maps with each. Yield what has been found,
    camera by camera."""

    def here(*arguments: object) -> str:
        argv = [sys.executable, "-m", "edgevpr", *map(str, arguments)]
        return userland.run(argv, {"PYTHONPATH": str(REPOSITORY)}).stdout

    maps, rows = [], []
    pictures = compare.make_pictures(arm.work, SEED, here)
    with ThreadPoolExecutor() as pool:
        running = [
            pool.submit(compare.compared, arm.work, pictures, camera, SEED, here, arm.edgevpr)
            for camera in compare.CAMERAS
        ]
        for done in as_completed(running):
            of_maps, of_flights = done.result()
            maps += map(asdict, of_maps)
            rows += map(asdict, of_flights)
            print(of_flights, flush=True)
            yield {"every": compare.EVERY, "maps": maps, "flights": rows}


def wheels(arm: Arm) -> Iterator[dict[str, Any]]:
    """Ask which glibc the locked wheels need."""
    yield {
        "named": {
            machine: {python: glibc.by_name(LOCK, machine, python) for python in PYTHONS} for machine in MACHINES
        },
        "asked": glibc.by_content(arm.locked),
    }


PARTS = {"wheels": wheels, "flights": flights, "tests": tests, "demo": demo}


if __name__ == "__main__":
    main()
