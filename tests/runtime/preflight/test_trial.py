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
def test_a_technique_is_tried_in_a_process_of_its_own_and_its_memory_is_its_own():
    ballast = np.ones(300_000_000, np.uint8)  # which is ours, and not the technique's
    (found,) = try_each(offers(["seqslam"]), threads=1)
    assert (found.label, found.problem, found.weights) == ("seqslam", None, None)
    assert found.parameters
    assert 30 < found.costs.process_mb < 250
    assert found.costs.encode.wall_s > 0
    assert ballast.size


@pytest.mark.process
def test_a_network_that_is_not_there_is_one_row():
    (found,) = try_each(offers(["calc"], settings={"calc": {"model": "nowhere"}}), threads=1)
    assert found.label == "calc"
    assert found.problem.startswith("There is no model `nowhere`")


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
        ("sys.exit('no numpy')", "(no numpy)"),
        ("sys.exit(3)", "(exit code 3)"),
    ],
)
def test_a_process_that_dies_is_a_row_that_says_so_and_the_others_go_on(monkeypatch, line, part):
    program(monkeypatch, line)
    found = list(try_each([*offers(["hog"]), *offers(["seqslam"])], threads=1))
    assert [each.label for each in found] == ["hog", "seqslam"], "one row for all forms of what cannot be used"
    assert part in found[0].problem
    assert found[0].costs is None
