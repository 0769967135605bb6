"""Techniques tried in processes of their own, some of which die."""

import json
import signal
import subprocess
import sys
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest

from edgevpr.core import child
from edgevpr.core.errors import ConfigError
from edgevpr.runtime.preflight import trial as trying
from edgevpr.runtime.preflight.trial import Trial, model_of, offers, trial_of, try_each


@pytest.fixture(autouse=True)
def no_models(monkeypatch, tmp_path):
    monkeypatch.setenv("EDGEVPR_MODELS", str(tmp_path / "models"))


@pytest.mark.slow
def test_a_technique_is_tried_in_a_process_of_its_own_and_its_memory_is_its_own():
    ballast = np.ones(300_000_000, np.uint8)  # which is ours, and not the technique's
    (found,) = try_each(offers(["seqslam"]), threads=1)
    assert (found.label, found.problem, found.model) == ("seqslam", None, None)
    assert 30 < found.costs.process_mb < 250
    assert found.costs.encode.wall_s > 0
    assert ballast.size
    assert trial_of(json.loads(json.dumps(asdict(found)))) == found
    with pytest.raises(ConfigError):
        trial_of({"label": "x"})


def test_a_network_that_is_not_there_is_one_row_and_needs_no_process(monkeypatch):
    monkeypatch.setattr(child.subprocess, "Popen", None)
    named = {"calc": {"model": "nowhere"}, "netvlad": {"model": "nowhere"}}
    found = list(try_each(offers(["calc", "netvlad"], settings=named), threads=1))
    assert [each.label for each in found] == ["calc", "netvlad"]
    assert all(each.problem.startswith("There is no model `nowhere`") for each in found)


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


def test_ctrl_c_leaves_no_process_behind(monkeypatch):
    started = []
    really = subprocess.Popen

    class Interrupted(really):
        def __init__(self, argv, **more):
            super().__init__([sys.executable, "-c", "import time; time.sleep(60)"], **more)
            assert more["start_new_session"], "or it would be interrupted itself, with a traceback"
            started.append(self)

        def communicate(self, *args, **more):
            raise KeyboardInterrupt

    monkeypatch.setattr(child.subprocess, "Popen", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(try_each(offers(["hog"]), threads=1))
    assert started[0].poll() == -signal.SIGKILL
    for pipe in (started[0].stdin, started[0].stdout, started[0].stderr):
        pipe.close()


def test_a_technique_without_a_network_has_no_fingerprint_and_one_with_it_that_of_its_card(monkeypatch):
    assert model_of("hog", {"form": "1bit"}) is None
    monkeypatch.setattr(trying, "load_card", lambda name: SimpleNamespace(fingerprint=f"of {name}"))
    assert model_of("calc", {}) == "of calc"
    assert model_of("calc", {"model": "mine"}) == "of mine"
    assert [offer.name for offer in offers(["hog"])] == ["hog"] * 3


def test_what_is_known_is_not_tried_again_and_what_is_not_is(monkeypatch):
    def answer(module, job, limit_s, what):
        asked.append(job["trial"]["label"])
        return job["trial"]

    asked = []
    monkeypatch.setattr(trying, "ask_child", answer)
    wanted = [*offers(["netvlad"], settings={"netvlad": {"model": "nowhere"}}), *offers(["hog"]), *offers(["cohog"])]
    known = {"hog 1bit": Trial(label="hog 1bit", name="hog", settings={}, measured=True)}
    found = list(try_each(wanted, 1, lambda offer: known.get(offer.label)))
    assert asked == ["hog", "hog 8bit", "cohog"]
    assert [(trial.label, trial.measured) for trial in found] == [
        ("netvlad", False), ("hog", False), ("hog 8bit", False), ("hog 1bit", True), ("cohog", False),
    ], "in the order of preference"  # fmt: skip
