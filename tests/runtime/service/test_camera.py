"""Findings of `edgevpr check` and `doctor` about cameras: program, devices, cable, and a frame that fits the lens."""

import os

import cv2
import fake_rpicam
import numpy as np
import pytest
from distorted_cameras import make_wide_camera

from edgevpr.core.config import load_config
from edgevpr.core.errors import ImageError
from edgevpr.core.reasons import ReasonCode
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import Source
from edgevpr.runtime.service import camera
from edgevpr.runtime.service.findingcodes import FindingCode


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
    monkeypatch.setenv("PATH", fake_rpicam.install(tmp_path))


@pytest.mark.process
@pytest.mark.usefixtures("rpicam")
def test_check_camera_lists_the_cameras_on_the_ribbon(root, monkeypatch):
    (finding,) = camera.check_camera("rpicam", root)
    assert (finding.ok, finding.reason.parameters["camera"]) == (True, "imx219")
    assert next(camera.check_camera("rpicam:1", root)).reason.parameters["cameras"] == "0"
    monkeypatch.setenv("FAKE_RPICAM", "absent")
    (finding,) = camera.check_camera("rpicam", root)
    assert (finding.ok, finding.reason.code) == (False, FindingCode.CAMERA_NOT_LISTED)


@pytest.mark.usefixtures("rpicam")
def test_check_camera_finds_a_device_of_the_ribbon_without_access(root, monkeypatch):
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: "dma_heap" not in str(path) and access(path, mode))
    (finding,) = camera.check_camera("rpicam", root)
    assert (finding.ok, finding.reason.parameters["path"]) == (False, "/dev/dma_heap/linux,cma")


@pytest.mark.parametrize("uri", ["rpicam", "gst: v4l2src ! appsink"])
def test_check_camera_finds_a_missing_program(root, monkeypatch, uri):
    monkeypatch.setenv("PATH", str(root))
    (finding,) = camera.check_camera(uri, root)
    assert (finding.ok, finding.reason.code) == (False, ReasonCode.UNUSABLE)


def test_check_camera_finds_a_program_that_has_it_open(root):
    assert next(camera.check_camera("/dev/video0", root)).ok
    (root / "proc/812/fd").mkdir(parents=True)
    (root / "proc/812/stat").write_text("812 (guvcview) S 1 812 812 0 -1 4194304")
    (root / "proc/812/fd/7").symlink_to("/dev/null")
    assert next(camera.check_camera("/dev/video0", root)).reason.parameters["program"] == "guvcview (process 812)"


def test_check_frame_compares_the_frame_with_the_lens(tmp_path):
    lens = str(make_wide_camera().write(tmp_path / "lens.yaml"))
    folder = tmp_path / "images"
    folder.mkdir()
    grey = np.zeros((480, 640), np.uint8)
    cv2.imwrite(str(folder / "1.png"), grey)
    source = load_config(None, {"source.uri": str(folder), "source.lens": lens}).source
    found = camera.check_frame("source", source).reason.parameters
    assert (found["width"], found["height"], found["lens"], round(found["fov_deg"])) == (640, 480, lens, 99)
    cv2.imwrite(str(folder / "1.png"), grey[60:420])
    with pytest.raises(ImageError, match="640x360"):
        camera.check_frame("source", source)


def test_check_frame_refuses_both_pictures_of_a_stereo_pair(monkeypatch):
    """Of a live source the first picture decides: the flight would refuse those after it, too."""

    class Stereo(Source):
        is_live, ended, condition, state = True, False, Condition.RUNNING, "streaming"

        def read(self, timeout_s):
            raise ImageError("both halves show the same")

    monkeypatch.setattr(camera, "open_source", lambda *_, **__: Stereo())
    with pytest.raises(ImageError, match="both halves"):
        camera.check_frame("source", load_config(None, {"source.uri": "tcp://127.0.0.1:1"}).source)
