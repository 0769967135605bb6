"""requirements.lock: every aircraft gets the same, and nobody has changed it on the way."""

import re
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "deploy" / "requirements.lock"
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})")


def read_lock() -> list[tuple[Requirement, list[str]]]:
    """Each line of the lock: what is required, and its hashes."""
    text = LOCK.read_text("utf-8").replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return [(Requirement(line.partition("--hash")[0]), HASH.findall(line)) for line in lines]


def read_dependencies() -> list[Requirement]:
    """The runtime dependencies of pyproject.toml."""
    listed = re.search(r"(?ms)^dependencies = \[\n(.*?)^\]", (ROOT / "pyproject.toml").read_text("utf-8"))
    found = [Requirement(text) for text in re.findall(r'"([^"]+)"', listed[1])]
    assert len(found) >= 8
    return found


@pytest.mark.parametrize("python", PYTHONS)
def test_lock_has_every_dependency_once_with_a_hash(python):
    for dependency in read_dependencies():
        name = canonicalize_name(dependency.name)
        for machine in ("aarch64", "x86_64"):
            here = {"python_version": python, "platform_machine": machine}
            found = [
                (each, hashes)
                for each, hashes in read_lock()
                if canonicalize_name(each.name) == name and (not each.marker or each.marker.evaluate(here))
            ]
            assert len(found) == 1, f"{name} on Python {python}: run `python deploy/lock.py`"
            ((each, hashes),) = found
            (pin,) = each.specifier
            assert pin.operator == "=="
            assert dependency.specifier.contains(pin.version), f"{each} is not {dependency}"
            assert hashes
