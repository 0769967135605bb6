"""A Debian system for 64-bit ARM in a folder, with Python, and wheels for it; QEMU runs it.

Only the program is emulated: its system calls are this machine's, and so are its files but for those of `system`.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
RELEASE = "bookworm"  # glibc 2.36, Python 3.11: that of Raspberry Pi OS 12
PYTHON = "3.11"
CPU = "cortex-a53"  # an instruction that a Raspberry Pi 3 or Zero 2 W has not ends the program
# As Linux tells it of a Raspberry Pi Zero 2 W.
_CPUINFO = """\
processor\t: {}
BogoMIPS\t: 38.40
Features\t: fp asimd evtstrm crc32 cpuid
CPU implementer\t: 0x41
CPU architecture: 8
CPU variant\t: 0x0
CPU part\t: 0xd03
CPU revision\t: 4
"""
_GLIBC = ("2_17", "2_24", "2_26", "2_27", "2_28")  # of the wheels


def make_system(folder: Path) -> None:
    """Make a Debian system for aarch64 with Python in a new folder, from Debian's packages; needs root for that."""
    packages = "python3,libsqlite3-0,libstdc++6"
    run(
        ["debootstrap", "--foreign", "--arch=arm64", "--variant=minbase", f"--include={packages}", RELEASE, str(folder)]
    )
    for archive in sorted((folder / "var/cache/apt/archives").glob("*.deb")):
        run(["dpkg-deb", "-x", str(archive), str(folder)])
        archive.unlink()
    # QEMU looks for every path here first: devices and settings are to be this machine's.
    for each in folder.iterdir():
        if each.name not in ("usr", "lib", "bin", "sbin"):
            shutil.rmtree(each)
    # onnxruntime looks here for what the processor can do, and does not survive that of this machine.
    (folder / "proc").mkdir()
    (folder / "proc/cpuinfo").write_text("\n".join(_CPUINFO.format(number) for number in range(4)))


def make_launcher(system: Path, qemu: str) -> Path:
    """Compile the Python that runs itself under QEMU, and return it."""
    names = {"QEMU": qemu, "CPU": CPU, "SYSTEM": str(system), "PYTHON": str(system / f"usr/bin/python{PYTHON}")}
    launcher = system / "usr/bin/python"
    defined = [f'-D{name}="{value}"' for name, value in names.items()]
    run(["gcc", "-O2", "-static", *defined, "-o", str(launcher), str(HERE / "launcher.c")])
    return launcher


def install(site: Path, *what: str) -> None:
    """Unpack wheels for aarch64 into a folder: arguments of `pip install`, such as names or `-r FILE`."""
    names = [*(f"manylinux_{each}" for each in _GLIBC), "manylinux2014"]
    tags = ["--only-binary=:all:", "--implementation=cp", f"--python-version={PYTHON}"]
    tags += [f"--platform={name}_aarch64" for name in names]
    run([sys.executable, "-m", "pip", "install", "--quiet", f"--target={site}", *tags, *what])


@dataclass(frozen=True, slots=True)
class Arm:
    """The emulated Python, the folders of its wheels (the lock's, the tests', edgevpr's own), a folder to work in, and
    this machine's FFmpeg, which only makes films for tests."""

    python: Path
    locked: Path
    tools: Path
    own: Path
    work: Path
    ffmpeg: str

    @property
    def env(self) -> dict[str, str]:
        """The variables of a program that uses all of them."""
        paths = os.pathsep.join(map(str, (self.own, self.locked, self.tools)))
        return {**os.environ, "PYTHONPATH": paths, "IMAGEIO_FFMPEG_EXE": self.ffmpeg}


def versions(arm: Arm, qemu: str) -> dict[str, Any]:
    """Return what the emulated system is made of."""
    asked = "import platform; print(platform.machine(), platform.python_version(), platform.libc_ver()[1])"
    machine, python, libc = run([str(arm.python), "-c", asked], arm.env).stdout.split()
    packages = {each.metadata["Name"]: each.version for each in metadata.distributions(path=[str(arm.locked)])}
    told = {"processor": machine, "cpu": CPU, "qemu": run([qemu, "--version"]).stdout.split("\n")[0]}
    return {**told, "release": RELEASE, "python": python, "glibc": libc, "packages": dict(sorted(packages.items()))}


def run(argv: Sequence[str], env: Mapping[str, str] | None = None) -> subprocess.CompletedProcess:
    """Run a command, with `env` beside the variables of this process; one that fails ends the program with its
    output."""
    done = subprocess.run(argv, capture_output=True, text=True, env={**os.environ, **(env or {})})
    if done.returncode:
        sys.exit(f"{' '.join(argv[:4])} ... failed: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done
