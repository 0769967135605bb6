"""Provenance of a measurement, which is stored with every result: the date, the machine and the versions."""

import os
import platform
from datetime import datetime, timezone
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import edgevpr

PACKAGE = Path(edgevpr.__file__).parent
_LIBRARIES = {"numpy": "numpy", "opencv": "opencv-python-headless", "onnxruntime": "onnxruntime", "scipy": "scipy"}


def today() -> str:
    """Return the date in UTC, like 2026-01-31."""
    return datetime.now(timezone.utc).strftime("%Y-%m-%d")


@cache
def versions() -> dict[str, str | None]:
    """Return the versions of edgevpr, Python and the libraries that decide a figure; None for one that is missing."""
    return {"edgevpr": edgevpr.__version__, "python": platform.python_version()} | {
        name: version_of(package) for name, package in _LIBRARIES.items()
    }


def machine() -> dict[str, Any]:
    """Return the machine: its processor, the cores this process may use, and the threads of NumPy's BLAS library."""
    return {
        "cpu": cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS", "all"),
    }


@cache
def cpu_model() -> str:
    """Return the name of the processor, or its architecture (such as aarch64) if the system gives no name."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith(("model name", "Model")):
            return line.partition(":")[2].strip()
    return platform.machine()


def version_of(package: str) -> str | None:
    """Return the version of an installed package; None where it is missing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
