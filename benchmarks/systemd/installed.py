"""A machine with this checkout's edgevpr on it, installed as deploy/README.md says."""

import json
import time
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
_DISKS = {"maps": "96M", "logs": "64M"}


@contextmanager
def installed_trial() -> Iterator[tuple[Trial, dict[str, Any]]]:
    """Give a machine that flies, and what is to be said of it."""
    where = image.folder()
    image.make(where)
    make_flight(where / "flight")
    with TemporaryDirectory(prefix="edgevpr-machine-", dir=where) as name:
        folder = Path(name)
        layered = ["qemu-img", "create", "-q", "-f", "qcow2", "-F", "raw", "-b"]
        image.run(*layered, where / "debian.raw", folder / "root.qcow2")
        for disk, size in _DISKS.items():
            image.run("mkfs.ext4", "-q", "-L", disk, folder / f"{disk}.raw", size)
            image.run("qemu-img", "convert", "-O", "qcow2", folder / f"{disk}.raw", folder / f"{disk}.qcow2")
        machine, world = Machine(where, folder), World(where / "flight")
        try:
            machine.boot()
            about = _install(machine, image.make_wheel(folder / "wheel"), where / "flight/valley.gpkg")
            machine.shut_down()
            about["boot_s"] = round(machine.boot(), 1)
            trial = Trial(machine, world)
            trial.configure()
            trial.tried("systemctl enable edgevpr")
            yield trial, about
        finally:
            machine.shut_down()
            world.close()


def _install(machine: Machine, wheel: Path, valley: Path) -> dict[str, Any]:
    machine.put(f"/root/{wheel.name}", wheel.read_bytes())
    machine.put("/root/valley.gpkg", valley.read_bytes())
    machine.put("/root/config.yaml", json.dumps({"board": "rpi-zero-2w", "map": MAP}).encode())
    begin_s = time.monotonic()
    machine.run(f"set -e\nexport HOME=/root\n{_INSTALL}", limit_s=1200)
    installed_s = round(time.monotonic() - begin_s)
    systemd = machine.run("systemctl --version | head -1; . /etc/os-release; echo $PRETTY_NAME; uname -r").text
    inside = ", ".join(systemd.split("\n")[:3])
    return {"inside": inside, "processor": "emulated by QEMU (TCG), 2 cores", "installed_s": installed_s}
