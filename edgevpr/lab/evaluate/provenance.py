"""Describes the provenance of a measurement (date, machine and versions), which is stored with every result."""

import os
import platform
from datetime import datetime, timezone
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import edgevpr

_PACKAGES = {"numpy": "numpy", "opencv": "opencv-python-headless", "onnxruntime": "onnxruntime", "scipy": "scipy"}


@cache
def read_versions() -> dict[str, str | None]:
    """Return the versions of edgevpr, Python and the libraries that affect results; None if one is missing."""
    versions: dict[str, str | None] = {"edgevpr": edgevpr.__version__, "python": platform.python_version()}
    for name, package in _PACKAGES.items():
        try:
            versions[name] = version(package)
        except PackageNotFoundError:
            versions[name] = None
    return versions


@cache
def read_cpu_model() -> str:
    """Return the name of the processor, or its architecture (such as aarch64) if the system reports no name."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith(("model name", "Model")):
            return line.partition(":")[2].strip()
    return platform.machine()


def describe_origin() -> dict[str, Any]:
    """Return the date in UTC (like 2026-01-31), the machine and the versions to store with a result. The machine: its
    processor, the number of cores this process may use, and the threads of NumPy's BLAS library."""
    today, threads = datetime.now(timezone.utc).date(), os.environ.get("OPENBLAS_NUM_THREADS", "all")
    machine = {"cpu": read_cpu_model(), "cores": len(os.sched_getaffinity(0)), "blas_threads": threads}
    return {"date": today.isoformat(), "machine": machine, "versions": read_versions()}
