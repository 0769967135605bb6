"""A machine with this checkout's edgevpr on it, installed as deploy/README.md says."""

import hashlib
import json
import shutil
import subprocess
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import image
from machine import Machine
from trial import MAP, Trial
from world import World, make_flight

# What deploy/README.md has a user type, but for the names of the files.
_INSTALL = """
cd /root && python3 -m venv ~/edgevpr
~/edgevpr/bin/pip install --no-deps edgevpr-*.whl pyyaml psutil
~/edgevpr/bin/edgevpr service install --dry-run
~/edgevpr/bin/edgevpr service install --config /root/config.yaml
install -m 644 /root/valley.gpkg /var/lib/edgevpr/
"""
# And with a newer edgevpr, on the ground.
_INSTALL_NEWER = """
~/edgevpr/bin/pip install --no-deps --force-reinstall /root/edgevpr-*.whl
~/edgevpr/bin/edgevpr service install
"""
_DISKS = {"maps": "96M", "logs": "64M"}


@contextmanager
def installed_trial() -> Iterator[tuple[Trial, dict[str, Any]]]:
    """Give a machine that flies, and what is to be said of it."""
    where = image.folder()
    image.make(where)
    make_flight(where / "flight")
    about = _installed(where)
    with TemporaryDirectory(prefix="edgevpr-machine-", dir=where) as folder:
        for name in ("root", *_DISKS):
            _layer(Path(folder) / f"{name}.qcow2", where / "installed" / f"{name}.qcow2")
        machine, world = Machine(where, Path(folder)), World(where / "flight")
        trial = Trial(machine, world)
        try:
            about["boot_s"] = round(machine.boot(), 1)
            trial.configure()
            trial.tried("systemctl enable edgevpr")
            yield trial, about
        finally:
            machine.shut_down()
            world.close()


def _installed(where: Path) -> dict[str, Any]:
    """Install this checkout's wheel, on a fresh machine or over an older one; return what is to be said of it."""
    wheel = image.make_wheel(where / "wheel")
    folder, kept = where / "installed", where / "installed" / "about.json"
    with zipfile.ZipFile(wheel) as parts:
        own = hashlib.sha256(repr(sorted((each.filename, each.CRC) for each in parts.infolist())).encode()).hexdigest()
    about = json.loads(kept.read_text()) if kept.exists() else None
    if about is None:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        _layer(folder / "root.qcow2", where / "debian.raw")
        for name, size in _DISKS.items():
            image.make_disk(where / f"{name}.raw", name, size)
            _layer(folder / f"{name}.qcow2", where / f"{name}.raw")
    if about is None or about["wheel"] != own:
        about = _install(Machine(where, folder), wheel, where / "flight/valley.gpkg", about) | {"wheel": own}
        kept.write_text(json.dumps(about))
    return {key: value for key, value in about.items() if key != "wheel"}


def _install(machine: Machine, wheel: Path, valley: Path, before: dict[str, Any] | None) -> dict[str, Any]:
    machine.boot()
    machine.put(f"/root/{wheel.name}", wheel.read_bytes())
    machine.put("/root/valley.gpkg", valley.read_bytes())
    machine.put("/root/config.yaml", json.dumps({"board": "rpi-zero-2w", "map": MAP}).encode())
    begin_s = time.monotonic()
    machine.run(f"set -e\nexport HOME=/root\n{_INSTALL_NEWER if before else _INSTALL}", limit_s=1200)
    installed_s = time.monotonic() - begin_s
    systemd = machine.run("systemctl --version | head -1; . /etc/os-release; echo $PRETTY_NAME; uname -r").text
    machine.shut_down()
    return {
        "inside": ", ".join(systemd.split("\n")[:3]),
        "processor": "emulated by QEMU (TCG), 2 cores",
        "installed_s": before["installed_s"] if before else round(installed_s),
    }


def _layer(path: Path, below: Path) -> None:
    kind = "raw" if below.suffix == ".raw" else "qcow2"
    path.unlink(missing_ok=True)
    words = "qemu-img", "create", "-q", "-f", "qcow2", "-F", kind, "-b", str(below), str(path)
    subprocess.run(words, check=True, capture_output=True)
