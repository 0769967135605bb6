"""Techniques tried in processes of their own, some of which die."""

import os
import signal

import pytest

from edgevpr.runtime.preflight import trial


def kill_hog_trial(trials, threads):
    if trials[0].name == "hog":
        os.kill(os.getpid(), signal.SIGKILL)
    return trials


@pytest.mark.process
@pytest.mark.usefixtures("models")
def test_run_trials_reports_a_process_that_dies_and_continues(monkeypatch):
    monkeypatch.setattr(trial, "_run_in_child", kill_hog_trial)
    found = list(trial.run_trials(trial.list_trials({"hog": {}, "seqslam": {}}), threads=1))
    assert [each.label for each in found] == ["hog", "seqslam"], "one row for all forms of what cannot be used"
    assert "crashed" in found[0].problem
    assert (found[0].costs, found[1].problem) == (None, None)
