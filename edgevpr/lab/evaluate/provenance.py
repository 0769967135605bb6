"""Origin of a figure: the date, the machine, the versions, the commit, and hashes of the code that was at work."""

import hashlib
import os
import platform
import subprocess
from datetime import datetime, timezone
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import edgevpr
from edgevpr.core.files import sha256_of
from edgevpr.core.resources import shipped

PACKAGE = Path(edgevpr.__file__).parent
_LIBRARIES = {"numpy": "numpy", "opencv": "opencv-python-headless", "onnxruntime": "onnxruntime", "scipy": "scipy"}


def today() -> str:
    """Return the date, UTC."""
    return datetime.now(timezone.utc).strftime("%Y-%m-%d")


@cache
def versions() -> dict[str, str | None]:
    """Return the versions of edgevpr, Python and the libraries that decide a figure; None for one that is missing."""
    return {"edgevpr": edgevpr.__version__, "python": platform.python_version()} | {
        name: _version(package) for name, package in _LIBRARIES.items()
    }


def machine() -> dict[str, Any]:
    """Return the machine: its processor, the cores this process may use, and the threads of NumPy's library."""
    return {
        "cpu": cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS", "all"),
    }


@cache
def cpu_model() -> str:
    """Return the name of the processor, or its kind where it has none."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith(("model name", "Model")):
            return line.partition(":")[2].strip()
    return platform.machine()


@cache
def commit_of(checkout: Path = PACKAGE.parent) -> str | None:
    """Return the commit of a checkout, and whether something has changed since; None where it is none."""

    def git(*arguments: str) -> str:
        try:
            done = subprocess.run(["git", "-C", str(checkout), *arguments], capture_output=True, text=True)
        except OSError:  # no git on this machine
            return ""
        return done.stdout.strip()

    # An installed package may lie in the checkout of something else.
    if not (checkout / ".git").exists() or not (commit := git("rev-parse", "--short", "HEAD")):
        return None
    return commit + (" with changes" if git("status", "--porcelain", "--", "edgevpr", "models") else "")


@cache
def code_of_techniques() -> str:
    """Return the hash of all that makes a descriptor of a picture, but for the networks: the techniques' files and the
    versions of the libraries."""
    return _hash([*(PACKAGE / "techniques").rglob("*.py"), PACKAGE / "contract.py"])


@cache
def code_of_everything() -> str:
    """Return the hash of all that makes an answer: the whole package, what it ships, and the versions of the
    libraries."""
    shipped_files = [path for kind in ("models", "profiles", "deploy") for path in shipped(kind).rglob("*")]
    return _hash([*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.json"), *shipped_files])


@cache
def code_of_frames() -> str:
    """Return the hash of all that takes the frames of a video: the room of the frames, and the version of PyAV."""
    return _hash([*(PACKAGE / "frames").rglob("*.py")]) + f" av {_version('av')}"


def _hash(paths: list[Path]) -> str:
    found = hashlib.sha256(repr(sorted(versions().items(), key=str)).encode())
    for path in sorted({path for path in paths if path.is_file() and "__pycache__" not in path.parts}):
        found.update(path.as_posix().removeprefix(PACKAGE.parent.as_posix()).encode() + b"\0")
        found.update(sha256_of(path).encode())
    return found.hexdigest()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
