"""Techniques tried in processes of their own, some of which die."""

import signal
import subprocess
import sys

import numpy as np
import pytest

from edgevpr.core import child
from edgevpr.runtime.preflight.trial import offers, try_each


@pytest.fixture(autouse=True)
def no_models(monkeypatch, tmp_path):
    monkeypatch.setenv("EDGEVPR_MODELS", str(tmp_path / "models"))


@pytest.mark.slow
def test_try_each_measures_in_a_process_of_its_own():
    ballast = np.ones(300_000_000, np.uint8)  # which is ours, and not the technique's
    (found,) = try_each(offers(["seqslam"]), threads=1)
    assert (found.label, found.problem, found.weights) == ("seqslam", None, None)
    assert found.parameters
    assert 30 < found.costs.process_mb < 250
    assert found.costs.encode.wall_s > 0
    assert ballast.size


def program(monkeypatch, *lines):
    """Let another program stand in for the process."""
    really = subprocess.Popen
    code = "; ".join(["import sys, os", "sys.stdin.read()", *lines])
    monkeypatch.setattr(child.subprocess, "Popen", lambda argv, **more: really([sys.executable, "-c", code], **more))


@pytest.mark.parametrize(
    ("line", "part"),
    [
        (f"os.kill(os.getpid(), {int(signal.SIGILL)})", "SIGILL: a library"),
        (f"os.kill(os.getpid(), {int(signal.SIGKILL)})", "SIGKILL: memory"),
        ("sys.exit(3)", "(exit code 3)"),
    ],
)
def test_try_each_reports_a_process_that_dies_and_goes_on(monkeypatch, line, part):
    program(monkeypatch, line)
    found = list(try_each([*offers(["hog"]), *offers(["seqslam"])], threads=1))
    assert [each.label for each in found] == ["hog", "seqslam"], "one row for all forms of what cannot be used"
    assert part in found[0].problem
    assert found[0].costs is None
