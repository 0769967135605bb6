"""The oldest C library that the locked wheels run with: by their names, and by what the libraries in them ask for."""

import json
import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from arm64.userland import run, tags
from packaging.requirements import Requirement

_NAMED = re.compile(r"manylinux_(\d+)_(\d+)_|manylinux(2014|2010|1)_")
_OLD = {"2014": (2, 17), "2010": (2, 12), "1": (2, 5)}
# https://sources.debian.org/src/glibc and https://launchpad.net/ubuntu/+source/glibc
RELEASES = {
    (2, 27): "Ubuntu 18.04 (JetPack 4)",
    (2, 28): "Debian 10",
    (2, 31): "Debian 11, Ubuntu 20.04 (JetPack 5)",
    (2, 35): "Ubuntu 22.04 (JetPack 6)",
    (2, 36): "Debian 12, Raspberry Pi OS 12",
}

Glibc = tuple[int, int]


def by_name(lock: Path, machine: str, python: str) -> dict[str, Glibc]:
    """Let pip resolve the lock for a processor and a Python; return the least glibc that the name of each wheel
    allows."""
    with TemporaryDirectory() as folder:
        pins = Path(folder) / "pins.txt"
        pins.write_text(_pins(lock.read_text("utf-8"), machine, python))
        argv = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet", "--report", "-"]
        argv += [
            *tags(machine, python),
            "--target",
            f"{folder}/unused",
            "--require-hashes",
            "--no-deps",
            "-r",
            str(pins),
        ]
        packages = json.loads(run(argv).stdout)["install"]
    files = [each["download_info"]["url"].rpartition("/")[2] for each in packages]
    return {file.partition("-")[0]: _least(file) for file in files}


def by_content(site: Path) -> dict[str, Glibc]:
    """Return the newest version of glibc that the libraries of each folder of installed wheels ask for."""
    found: dict[str, Glibc] = {}
    for path in site.rglob("*.so*"):
        asked = re.findall(rb"GLIBC_(\d+)\.(\d+)", path.read_bytes())
        name = path.relative_to(site).parts[0]
        found[name] = max([found.get(name, (0, 0)), *((int(major), int(minor)) for major, minor in asked)])
    return found


def _least(file: str) -> Glibc:
    """Return the least glibc of a wheel by its name, (0, 0) for one that needs none."""
    named = [_OLD[old] if old else (int(major), int(minor)) for major, minor, old in _NAMED.findall(file)]
    return min(named, default=(0, 0))


def _pins(lock: str, machine: str, python: str) -> str:
    """Return the lines of the lock that are for a processor and a Python, without their conditions: pip would judge
    these by its own Python."""
    here = {"python_version": python, "python_full_version": f"{python}.0", "platform_machine": machine, "extra": ""}
    lines = []
    for line in lock.replace("\\\n", " ").splitlines():
        pin, _, hashes = line.partition(" --hash")
        if pin and not pin.startswith("#"):
            required = Requirement(pin)
            if not required.marker or required.marker.evaluate(here):
                lines.append(f"{required.name}{required.specifier} --hash{hashes}\n")
    return "".join(lines)
