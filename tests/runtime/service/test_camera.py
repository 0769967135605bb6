"""What `edgevpr check` and `doctor` say of cameras: program, devices, cable, and a frame that fits the lens."""

import os
import socket
import sys
from pathlib import Path

import numpy as np
import pytest
from distorted_cameras import wide

from edgevpr.core.config import load_config
from edgevpr.core.errors import ImageError
from edgevpr.frames.images import write_png
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import Source
from edgevpr.runtime.service import camera
from edgevpr.runtime.service.camera import camera_findings, frame_seen

FAKE = Path(__file__).parents[2] / "frames/fake_rpicam.py"


@pytest.fixture
def root(tmp_path):
    """The root of a board with a camera's devices."""
    for name in ("dev/media0", "dev/video0", "dev/dma_heap/linux,cma"):
        path = tmp_path / "root" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to("/dev/null")
    return tmp_path / "root"


@pytest.fixture
def rpicam(tmp_path, monkeypatch):
    """rpicam-vid on the path, by the program that stands for it."""
    program = tmp_path / "rpicam-vid"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} {FAKE} "$@"\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")


@pytest.mark.process
@pytest.mark.usefixtures("rpicam")
def test_a_camera_on_the_ribbon_is_named_or_what_to_do_about_it(root, monkeypatch):
    (found,) = camera_findings("rpicam", root)
    assert found.ok
    assert "imx219" in found.message
    (second,) = camera_findings("rpicam:1", root)
    assert (second.ok, len(second.changes)) == (False, 2)
    monkeypatch.setenv("FAKE_RPICAM", "absent")
    (root / "boot/firmware").mkdir(parents=True)
    (root / "boot/firmware/config.txt").write_text("camera_auto_detect=1\n")
    (none,) = camera_findings("rpicam", root)
    assert (none.ok, len(none.changes)) == (False, 1)
    assert none.changes[0].startswith("both ends of the ribbon")


@pytest.mark.usefixtures("rpicam")
def test_a_device_of_the_ribbon_that_may_not_be_used_is_named(root, monkeypatch):
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: "dma_heap" not in str(path) and access(path, mode))
    (found,) = camera_findings("rpicam", root)
    assert not found.ok
    assert found.message.startswith("/dev/dma_heap/linux,cma may not be used by")


@pytest.mark.parametrize("uri", ["rpicam", "gst: v4l2src ! appsink"])
def test_without_the_program_the_camera_is_wrong(root, monkeypatch, uri):
    monkeypatch.setenv("PATH", str(root))
    (found,) = camera_findings(uri, root)
    assert not found.ok
    assert "sudo apt install" in found.message


def test_a_camera_that_another_program_has_open_is_not_free(root):
    (free,) = camera_findings("/dev/video0", root)
    assert free.ok
    (root / "proc/812/fd").mkdir(parents=True)
    (root / "proc/812/stat").write_text("812 (guvcview) S 1 812 812 0 -1 4194304")
    (root / "proc/812/fd/7").symlink_to("/dev/null")
    (held,) = camera_findings("/dev/video0", root)
    assert (held.ok, held.changes) == (False, ("stop guvcview (process 812)",))


def test_a_frame_is_held_against_the_lens(tmp_path):
    camera = wide()
    lens = str(camera.write(tmp_path / "lens.yaml"))
    folder = tmp_path / "images"
    folder.mkdir()
    grey = np.zeros((480, 640), np.uint8)
    write_png(folder / "1.png", grey)
    source = load_config(None, {"source.uri": str(folder), "source.lens": lens}).source
    assert frame_seen(source).endswith(f"640 x 480 pixels, of which {lens} shows 99 degrees")
    write_png(folder / "1.png", grey[60:420])
    with pytest.raises(ImageError, match="640x360"):
        frame_seen(source)


def test_a_camera_that_sends_both_pictures_of_a_stereo_pair_is_wrong(monkeypatch):
    """Of a live source the first picture decides: the flight would refuse those after it, too."""

    class Stereo(Source):
        is_live, ended, condition, state = True, False, Condition.RUNNING, "streaming"

        def read(self, timeout_s):
            raise ImageError("both halves show the same")

    monkeypatch.setattr(camera, "open_source", lambda *_, **__: Stereo())
    with pytest.raises(ImageError, match="both halves"):
        frame_seen(load_config(None, {"source.uri": "tcp://127.0.0.1:1"}).source)


def test_the_daemon_of_a_jetsons_ribbon_camera_is_looked_for(root, tmp_path, monkeypatch):
    (tmp_path / "gst-launch-1.0").write_text("#!/bin/sh\n")
    (tmp_path / "gst-launch-1.0").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    uri = "gst: nvarguscamerasrc sensor-id=0 ! nvvidconv ! video/x-raw,format=BGRx"
    (without,) = camera_findings(uri, root)
    assert (without.ok, len(without.changes)) == (False, 1)
    assert "/tmp/argus_socket is not there" in without.message
    monkeypatch.chdir(root)  # the path of a socket has at most 107 bytes
    (root / "tmp").mkdir()
    with socket.socket(socket.AF_UNIX) as daemon:
        daemon.bind("tmp/argus_socket")
        (found,) = camera_findings(uri, root)
    assert found.ok
    (other,) = camera_findings("gst: v4l2src", root)
    assert other.ok
    assert "argus" not in other.message


@pytest.mark.parametrize("error", [KeyError, OSError])
def test_a_user_without_a_name_is_named_by_the_number(error, root, monkeypatch):
    def nobody():
        raise error

    monkeypatch.setattr("getpass.getuser", nobody)
    (free,) = camera_findings("/dev/video0", root)
    assert free.ok
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr("edgevpr.runtime.service.finding._NOBODYS_GROUPS", ())
    (denied,) = camera_findings("/dev/video0", root)
    assert f"may not be used by user {os.getuid()} (" in denied.message
    assert denied.changes == (f"--group-add {Path('/dev/null').stat().st_gid}",)
