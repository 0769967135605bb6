"""Cameras that a program reads: on the ribbon cable of a Raspberry Pi, by a program that stands for rpicam-vid; and
pipelines, by GStreamer itself where it is installed."""

import shutil
import subprocess
import sys
import time

import fake_rpicam
import pytest
from loopback import wait_until

from edgevpr.core.errors import SourceError
from edgevpr.frames import programs, streams
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import is_live, open_source

pytestmark = [pytest.mark.process, pytest.mark.network, pytest.mark.slow]


GST = "gst: videotestsrc is-live=true pattern=ball ! video/x-raw,width=320,height=240,framerate=20/1"
needs_gstreamer = pytest.mark.skipif(
    not (shutil.which("gst-launch-1.0") and shutil.which("gst-inspect-1.0"))
    or any(
        subprocess.run(["gst-inspect-1.0", "--exists", name], capture_output=True).returncode
        for name in ("videotestsrc", "jpegenc", "tcpserversink")
    ),
    reason="GStreamer is not on this machine (Debian: apt install gstreamer1.0-tools and its plugins base and good)",
)


@pytest.fixture
def rpicam(tmp_path, monkeypatch, open_live_source):
    """rpicam-vid on the path, and a function that opens its camera."""
    monkeypatch.setenv("PATH", fake_rpicam.install(tmp_path))
    return lambda: open_live_source("rpicam")


def list_processes(program="fake_rpicam.py"):
    """The process ids of the programs that stand for rpicam-vid, or of another one."""
    found = subprocess.run(["pgrep", "-f", program], capture_output=True, text=True).stdout.split()
    return set(map(int, found))


def check_three_frames(source, shape):
    frames = [wait_until(lambda: source.read(1.0)) for _ in range(3)]
    assert {frame.image.shape for frame in frames} == {shape}
    assert frames[0].t_mono_s <= frames[1].t_mono_s <= frames[2].t_mono_s <= time.monotonic()
    assert source.condition is Condition.RUNNING


def test_ribbon_camera_gives_complete_images_and_its_program_ends_with_the_source(rpicam):
    before = list_processes()
    source = rpicam()
    check_three_frames(source, (960, 1280, 3))
    assert list_processes() - before
    source.close()
    wait_until(lambda: not list_processes() - before)


def test_ribbon_camera_is_restarted_if_it_hangs(rpicam, monkeypatch):
    monkeypatch.setenv("FAKE_RPICAM", "hangs")
    source = rpicam()
    wait_until(lambda: source.read(1.0))
    wait_until(lambda: source.condition is Condition.LOST)
    wait_until(lambda: source.read(1.0))


def test_ribbon_camera_may_start_slowly(rpicam, monkeypatch):
    monkeypatch.setattr(streams, "OPEN_TIMEOUT_S", 0.5)
    monkeypatch.setenv("FAKE_RPICAM", "slow")
    before = list_processes()
    source = rpicam()
    (process,) = wait_until(lambda: list_processes() - before)
    assert wait_until(lambda: source.read(1.0))
    assert list_processes() - before == {process}, "it was not started anew"


def test_program_without_images_is_ended_after_a_timeout(rpicam, monkeypatch):
    monkeypatch.setattr(programs, "_FIRST_PICTURE_TIMEOUT_S", 1.0)
    monkeypatch.setenv("FAKE_RPICAM", "slow")
    source = rpicam()
    wait_until(lambda: source.state.startswith("no picture from rpicam-vid in 1 s, reopening in "))


@pytest.mark.parametrize(
    ("text", "explanation"),
    [
        ("", ""),
        ("ERROR: no such device\nAdditional debug info:\nv4l2.c(616)", ": ERROR: no such device"),
        ("x" * 5000 + "\nSegmentation fault", ": Segmentation fault"),
        ("\n" * 30000 + "no\x1b[31m", ": no\\x1b[31m"),
    ],
)
def test_error_lines_explain_the_exit_of_a_program(text, explanation):
    process = subprocess.Popen(["sh", "-c", 'printf %b "$0" >&2', text], stderr=subprocess.PIPE)
    errors = programs.ErrorLines(process)
    process.wait()
    assert wait_until(lambda: not errors._thread.is_alive())
    assert errors.explain_exit() == explanation


def test_ribbon_camera_missing_is_reported_and_retried(rpicam, monkeypatch, caplog):
    monkeypatch.setenv("FAKE_RPICAM", "absent")
    source = rpicam()
    wait_until(lambda: source.condition is Condition.LOST)
    assert "code 1: ERROR: *** no cameras available ***" in source.state
    assert "--list-cameras" in caplog.text
    monkeypatch.delenv("FAKE_RPICAM")
    wait_until(lambda: source.read(1.0))


@pytest.mark.parametrize(
    ("uri", "packages"), [("rpicam", "rpicam-apps"), ("rpicam:1", "rpicam-apps"), (GST, "gstreamer1.0-tools")]
)
def test_open_source_names_the_package_of_a_missing_program(monkeypatch, tmp_path, uri, packages):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert is_live(uri)
    assert not is_live("rpicam:x")
    with pytest.raises(SourceError, match=f"apt install {packages}"):
        open_source(uri, live=True)


@pytest.mark.parametrize("pipeline", ["gst:", "gst: ! appsink", "gst: v4l2src device='/dev/video0"])
def test_open_source_refuses_an_invalid_pipeline(pipeline):
    with pytest.raises(SourceError, match="must be `gst:` and a pipeline"):
        open_source(pipeline, live=True)


@needs_gstreamer
@pytest.mark.parametrize("end", ["", " ! videoconvert ! appsink drop=true"])
def test_pipeline_gives_images_and_ends_with_the_source(open_live_source, end):
    before = list_processes("gst-launch-1.0 -q videotestsrc")
    source = open_live_source(GST + end)
    check_three_frames(source, (240, 320, 3))
    wait_until(lambda: source.read(1.0) and source.latency_s < 1)
    source.close()
    wait_until(lambda: not list_processes("gst-launch-1.0 -q videotestsrc") - before)


def test_programs_end_with_a_killed_flight(rpicam):
    before = list_processes()
    opening = "from edgevpr.frames.source import open_source; s = open_source('rpicam', live=True)"
    flight = subprocess.Popen([sys.executable, "-c", f"{opening}\nwhile True: s.read(1)"])
    wait_until(lambda: list_processes() - before)
    flight.kill()
    flight.wait()
    wait_until(lambda: not list_processes() - before)
