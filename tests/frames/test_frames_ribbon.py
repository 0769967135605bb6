"""Cameras on the ribbon cable of a Raspberry Pi, by a program that stands for rpicam-vid."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from live_sources import wait_for

from edgevpr.core.errors import SourceError
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import is_live, open_source

pytestmark = [pytest.mark.process, pytest.mark.network, pytest.mark.slow]


@pytest.fixture
def rpicam(tmp_path, monkeypatch, opened):
    """rpicam-vid on the path, and a function that opens its camera."""
    program = tmp_path / "rpicam-vid"
    fake = Path(__file__).with_name("fake_rpicam.py")
    program.write_text(f'#!/bin/sh\nexec {sys.executable} {fake} "$@"\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    return lambda: opened("rpicam")


def running():
    """The process ids of the programs that stand for rpicam-vid."""
    found = subprocess.run(["pgrep", "-f", "fake_rpicam.py"], capture_output=True, text=True).stdout.split()
    return set(map(int, found))


def test_its_pictures_come_whole_and_of_known_age_and_the_program_ends_with_the_source(rpicam):
    before = running()
    source = rpicam()
    frames = [wait_for(lambda: source.read(1.0)) for _ in range(3)]
    assert {frame.image.shape for frame in frames} == {(960, 1280, 3)}
    assert frames[0].t_mono_s <= frames[1].t_mono_s <= frames[2].t_mono_s <= time.monotonic()
    assert source.condition is Condition.RUNNING
    assert running() - before
    source.close()
    wait_for(lambda: not running() - before)


def test_a_camera_that_hangs_is_started_anew(rpicam, monkeypatch):
    monkeypatch.setenv("FAKE_RPICAM", "hangs")
    source = rpicam()
    wait_for(lambda: source.read(1.0))
    wait_for(lambda: source.condition is Condition.LOST)
    wait_for(lambda: source.read(1.0))


def test_a_camera_that_is_not_there_is_said_and_looked_for_again(rpicam, monkeypatch, caplog):
    monkeypatch.setenv("FAKE_RPICAM", "absent")
    source = rpicam()
    wait_for(lambda: source.condition is Condition.LOST)
    assert "--list-cameras" in caplog.text
    monkeypatch.delenv("FAKE_RPICAM")
    wait_for(lambda: source.read(1.0))


def test_without_the_program_the_sentence_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert is_live("rpicam")
    assert is_live("rpicam:1")
    assert not is_live("rpicam:x")
    with pytest.raises(SourceError, match="apt install rpicam-apps"):
        open_source("rpicam", live=True)
