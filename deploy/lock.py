"""Write requirements.lock: every package that an aircraft needs, with its version and the hashes of its wheels.

    python deploy/lock.py     # asks PyPI, with pip and packaging; then read the difference, run the tests, and commit

pip resolves the dependencies of pyproject.toml for each Python and processor that edgevpr flies on, and reports what it
would install and the SHA-256 of each file. Where Pythons get different versions, the line says for which it is.
"""

import json
import os
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
LOCK = Path(__file__).with_name("requirements.lock")
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
MACHINES = ("aarch64", "x86_64")
GLIBC = ("2_17", "2_24", "2_26", "2_27", "2_28")  # of the wheels; Raspberry Pi OS 12 has 2.36, Ubuntu 22.04 2.35
PYPI = "https://files.pythonhosted.org/"
HEAD = """\
# What an aircraft needs, with hashes: wheels for aarch64 and x86_64, Python 3.10 to 3.13. Made by deploy/lock.py.
#     pip install --require-hashes --only-binary :all: -r requirements.lock
"""


def dependencies() -> list[str]:
    """Read the runtime dependencies of pyproject.toml."""
    listed = re.search(r"(?ms)^dependencies = \[\n(.*?)^\]", (ROOT / "pyproject.toml").read_text("utf-8"))
    return re.findall(r'"([^"]+)"', listed[1])


def resolved(python: str, machine: str) -> list[tuple[str, str, str]]:
    """Let pip resolve the dependencies for a Python and a processor; return (name, version, SHA-256) of each wheel."""
    tags = [f"manylinux_{each}_{machine}" for each in GLIBC] + [f"manylinux2014_{machine}"]
    platforms = [word for tag in tags for word in ("--platform", tag)]
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet", "--report", "-"]
    command += ["--only-binary", ":all:", "--implementation", "cp", "--python-version", python, "--target", "unused"]
    # Only PyPI is asked, whatever this machine is configured for: the aircraft's pip must find the same files.
    environment = {
        key: value for key, value in os.environ.items() if key not in ("PIP_FIND_LINKS", "PIP_EXTRA_INDEX_URL")
    }
    environment |= {"PIP_CONFIG_FILE": os.devnull, "PIP_INDEX_URL": "https://pypi.org/simple"}
    done = subprocess.run([*command, *platforms, *dependencies()], capture_output=True, text=True, env=environment)
    if done.returncode:
        sys.exit(done.stderr)
    packages = json.loads(done.stdout)["install"]
    names = {canonicalize_name(each["metadata"]["name"]) for each in packages}
    # pip judges conditions such as `python_version < "3.11"` by the Python that it runs on itself.
    target = {"python_version": python, "python_full_version": f"{python}.0", "platform_machine": machine, "extra": ""}
    for each in packages:
        if not each["download_info"]["url"].startswith(PYPI):
            sys.exit(f"{each['download_info']['url']} is not PyPI's: an aircraft could not get it.")
        for text in each["metadata"].get("requires_dist", []):
            needed = Requirement(text)
            if needed.marker and needed.marker.evaluate(target) and canonicalize_name(needed.name) not in names:
                sys.exit(f"{each['metadata']['name']} needs {text} on {python}: run this with Python {python}.")
    return [
        (
            canonicalize_name(each["metadata"]["name"]),
            each["metadata"]["version"],
            each["download_info"]["archive_info"]["hashes"]["sha256"],
        )
        for each in packages
    ]


def main() -> None:
    """Resolve for every Python and processor, and write the lock."""
    pythons, hashes = defaultdict(set), defaultdict(set)
    for python in PYTHONS:
        for machine in MACHINES:
            for name, version, sha256 in resolved(python, machine):
                pythons[name, version].add(python)
                hashes[name, version].add(sha256)
    lines = [HEAD]
    for (name, version), those in sorted(pythons.items()):
        where = " or ".join(f'python_version == "{python}"' for python in PYTHONS if python in those)
        pinned = f"{name}=={version}" + (f" ; {where}" if len(those) < len(PYTHONS) else "")
        each = [f"--hash=sha256:{sha256}" for sha256 in sorted(hashes[name, version])]
        lines.append(" \\\n    ".join([pinned, *each]))
    LOCK.write_text("\n".join(lines) + "\n", "utf-8")


if __name__ == "__main__":
    main()
