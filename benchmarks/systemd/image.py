"""The machine that the service is tried on: a Debian with systemd as a disk for QEMU, made from Debian's packages."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
NEEDED = ("debootstrap", "mkfs.ext4", "qemu-img", "qemu-system-x86_64")  # Debian: debootstrap, e2fsprogs, qemu-*
_SUITE, _MIRROR = "bookworm", "http://deb.debian.org/debian"
# What a user's Debian has, and the agent by which QEMU lets commands be run inside.
_PACKAGES = (
    "ca-certificates", "dbus", "e2fsprogs", "initramfs-tools", "iproute2", "kmod", "linux-image-amd64",
    "procps", "python3", "python3-venv", "qemu-guest-agent", "sudo", "systemd", "systemd-sysv", "udev",
)  # fmt: skip
_FILES = {
    "etc/hostname": "aircraft\n",
    "etc/fstab": (
        "/dev/vda / ext4 rw,relatime 0 1\n"
        "LABEL=maps /var/lib/edgevpr ext4 nofail,relatime 0 2\n"
        "LABEL=logs /var/log/edgevpr ext4 nofail,relatime,x-systemd.device-timeout=10 0 2\n"
    ),
    "etc/systemd/network/wired.network": "[Match]\nName=en*\n[Network]\nDHCP=yes\n",
    # There is no network but the host's: pip finds the wheels here, and holds them to the hashes of the lock.
    "etc/pip.conf": "[global]\nno-index = true\nfind-links = /opt/wheelhouse\n",
    "etc/systemd/journald.conf.d/keep.conf": "[Journal]\nStorage=persistent\nSyncIntervalSec=1s\nRateLimitBurst=0\n",
}


def folder() -> Path:
    """Return the folder that the machine is kept in, outside of the repository."""
    return Path(os.environ.get("EDGEVPR_MACHINE", Path.home() / ".cache" / "edgevpr-machine"))


def lacking() -> str | None:
    """Return in one sentence what this machine lacks to make another one in it, None where it lacks nothing."""
    missing = [name for name in NEEDED if shutil.which(name) is None]
    if missing:
        return f"{', '.join(missing)}: not on this machine (Debian: apt install debootstrap e2fsprogs qemu-system-x86)"
    return None if os.geteuid() == 0 else "debootstrap needs root"


def make(where: Path) -> None:
    """Make the disk, kernel and wheels, unless they are there; some minutes and 2 GB."""
    where.mkdir(parents=True, exist_ok=True)
    _make_wheelhouse(where / "wheelhouse")
    if (where / "debian.raw").exists():
        return
    root = where / "root"
    shutil.rmtree(root, ignore_errors=True)
    include = f"--include={','.join(_PACKAGES)}"
    run("debootstrap", "--variant=minbase", include, _SUITE, root, _MIRROR)
    for name, text in _FILES.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    (root / "etc/machine-id").write_text("")
    run("chroot", root, "systemctl", "enable", "systemd-networkd")
    shutil.copytree(where / "wheelhouse", root / "opt/wheelhouse")
    for kind in ("vmlinuz", "initrd.img"):
        shutil.copy(next((root / "boot").glob(f"{kind}-*")), where / kind)
    unfinished = where / "unfinished.raw"
    unfinished.unlink(missing_ok=True)
    run("mkfs.ext4", "-q", "-d", root, unfinished, "6G")
    shutil.rmtree(root)
    unfinished.rename(where / "debian.raw")


def make_wheel(where: Path) -> Path:
    """Make the wheel of this checkout."""
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", REPOSITORY, "--wheel-dir", where)
    return next(where.glob("edgevpr-*.whl"))


def _make_wheelhouse(where: Path) -> None:
    if where.exists():
        return
    unfinished = where.with_name("wheelhouse.unfinished")
    lock = REPOSITORY / "deploy" / "requirements.lock"
    words = "--quiet", "--no-deps", "--require-hashes", "--only-binary", ":all:", "--requirement", lock
    debian = "--python-version", "3.11", "--platform", "manylinux_2_28_x86_64", "--platform", "manylinux_2_17_x86_64"
    older = "--platform", "manylinux2014_x86_64", "--platform", "manylinux2010_x86_64"
    run(sys.executable, "-m", "pip", "download", *words, *debian, *older, "--dest", unfinished)
    unfinished.rename(where)


def run(*words: object) -> None:
    """Run a program. Raises RuntimeError, with what it said, where it fails."""
    done = subprocess.run([*map(str, words)], stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{words[0]} failed: {(done.stdout + done.stderr)[-2000:]}")
