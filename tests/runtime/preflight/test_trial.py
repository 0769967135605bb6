"""Techniques tried in processes of their own, some of which die."""

import os
import signal

import numpy as np
import pytest

from edgevpr.runtime.preflight import trial
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


def die_of_hog(trials, threads):
    if trials[0].name == "hog":
        os.kill(os.getpid(), signal.SIGKILL)
    return trials


@pytest.mark.process
def test_try_each_reports_a_process_that_dies_and_goes_on(monkeypatch):
    monkeypatch.setattr(trial, "_try_here", die_of_hog)
    found = list(try_each([*offers(["hog"]), *offers(["seqslam"])], threads=1))
    assert [each.label for each in found] == ["hog", "seqslam"], "one row for all forms of what cannot be used"
    assert "ended its process" in found[0].problem
    assert (found[0].costs, found[1].problem) == (None, None)
