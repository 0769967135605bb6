"""The part of the test suite that runs under emulation, file by file, and what is left out and why."""

import hashlib
import subprocess
import time
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

# What runs the code of compiled libraries: NumPy, SciPy, OpenCV, onnxruntime, PyAV, SQLite.
CORE = (
    "tests/techniques",
    "tests/runtime/recognise",
    "tests/frames",
    "tests/places",
    "tests/belief",
    "tests/navigation",
    "tests/confidence",
    "tests/landmarks",
    "tests/salience",
    "tests/test_tiny.py",
    "tests/test_yamlfile.py",
)
_PURE = "pure Python, which is the same on every processor"
_IN_REAL_TIME = "they fly in real time, for which emulation is too slow; the demonstration flies"
_OF_COMMANDS = "they start many commands, each of which takes long to start under emulation"
_ON_THE_GROUND = "not part of a flight"
_OF_THE_SOURCE = "it looks at files of the repository, not at what they do"
_OF_BENCHMARKS = "it tests programs that are not installed on a board"
LEFT_OUT = {
    **dict.fromkeys(("tests/runtime/service", "tests/runtime/replay"), _IN_REAL_TIME),
    **dict.fromkeys(("tests/helpers", "tests/mavlink", "tests/power", "tests/runtime/preflight"), _PURE),
    "tests/runtime/flight": f"{_PURE}, or in real time, for which emulation is too slow; the demonstration flies",
    **dict.fromkeys(("tests/cli", "tests/test_hostile_inputs.py"), _OF_COMMANDS),
    **dict.fromkeys(
        (
            "tests/calibrate",
            "tests/evaluate",
            "tests/pages",
            "tests/refine",
            "tests/report",
            "tests/simulate",
            "tests/training",
        ),
        _ON_THE_GROUND,
    ),
    **dict.fromkeys(
        ("tests/test_house.py", "tests/test_imports.py", "tests/test_lock.py", "tests/test_packaging.py"),
        _OF_THE_SOURCE,
    ),
    **dict.fromkeys(
        (
            "tests/test_on_arm64.py",
            "tests/test_peers.py",
            "tests/test_rig.py",
            "tests/test_service_faults.py",
            "tests/test_sites_and_sweeps.py",
            "tests/test_soak.py",
        ),
        _OF_BENCHMARKS,
    ),
    "tests/test_fakes.py": "it tests what only tests use",
}
# What no test of the core uses, but for those of image sets, which are not there.
_UNUSED = (*LEFT_OUT, *(f"edgevpr/{name}" for name in ("evaluate", "pages", "report", "training")))
_LIMIT_S = 3600.0  # of a file: most take a minute or two on a machine that does nothing else


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Counts of the tests of a file, the names of those that failed, and those that were skipped with the reason."""

    file: str
    commit: str
    passed: int
    failed: list[str]
    skipped: dict[str, str]
    took_s: float


def files(tree: Path) -> list[str]:
    """List the files of tests, in the order of `CORE`."""
    found = []
    for name in CORE:
        path = tree / name
        found += [name] if path.is_file() else [str(each.relative_to(tree)) for each in sorted(path.rglob("test_*.py"))]
    return found


def code_of(tree: Path) -> str:
    """Return a hash of all that decides how the tests end: package, tests, networks and locked versions."""
    read = hashlib.sha256()
    for name in ("edgevpr", "tests", "models", "deploy"):
        for path in sorted((tree / name).rglob("*")):
            here = str(path.relative_to(tree))
            if path.is_file() and "__pycache__" not in path.parts and not here.startswith(_UNUSED):
                read.update(here.encode() + path.read_bytes())
    return read.hexdigest()[:12]


def run_tests(python: Path, tree: Path, file: str, env: Mapping[str, str], commit: str) -> Outcome:
    """Run the tests of a file of `tree`. One that does not end in time, or crashes, counts as one failure."""

    def ended(took_s: float, passed: int, failed: list[str], skipped: dict[str, str]) -> Outcome:
        return Outcome(file=file, commit=commit, passed=passed, failed=failed, skipped=skipped, took_s=round(took_s, 1))

    start_s = time.monotonic()
    with TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        argv = [str(python), "-m", "pytest", "-p", "no:cacheprovider", f"--basetemp={folder}/tests"]
        argv += [f"--junitxml={report}", file]
        try:
            done = subprocess.run(argv, cwd=tree, env=env, capture_output=True, text=True, timeout=_LIMIT_S)
        except subprocess.TimeoutExpired:
            return ended(_LIMIT_S, 0, [f"{file} (not ended after {_LIMIT_S:g} s)"], {})
        took_s = time.monotonic() - start_s
        if not report.exists():
            return ended(took_s, 0, [f"{file} ({done.stdout[-500:]}{done.stderr[-500:]})"], {})
        cases = list(ET.parse(report).iter("testcase"))
    passed, failed, skipped = 0, [], {}
    for case in cases:
        name = f"{case.get('classname')}.{case.get('name')}"
        if (why := case.find("skipped")) is not None:
            skipped[name] = why.get("message", "").replace(f"{tree.parent}/", "")
        elif case.find("failure") is not None or case.find("error") is not None:
            failed.append(name)
        else:
            passed += 1
    return ended(took_s, passed, failed, skipped)
