"""Checks of the frame source for `edgevpr check` and `doctor`: the device or program that reads the camera, the ribbon
cable, and whether a first frame matches the lens calibration."""

import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from edgevpr.core.config import SourceConfig
from edgevpr.core.errors import ImageError
from edgevpr.core.types import MAX_FIX_AGE_S
from edgevpr.frames.lens import compute_lens_view
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import Source, is_program_uri, open_source
from edgevpr.runtime.recognise.levelling import load_calibrated_lens
from edgevpr.runtime.service.finding import Finding, check_device, report_fault, report_ok, run_check
from edgevpr.runtime.service.findingcodes import FindingCode

FRAME_WAIT_S = 65.0  # longer than any source needs to report that it is lost; slow pipelines take longest
_FRAMELESS_CONDITIONS = (Condition.LOST, Condition.FROZEN, Condition.DAMAGED, Condition.LATE)
_LIST_TIMEOUT_S = 10.0  # for the program's --list-cameras
_CAMERA_LINE = re.compile(r"(?m)^\s*(\d+) : (\S+)")
_LIBCAMERA_DEVICES = ("media*", "video*", "dma_heap/*")  # below /dev


def check_camera(uri: str, root: Path = Path("/")) -> Iterator[Finding]:
    """Check the device or program that reads a live source. Other sources yield no finding. `root`: root of
    the file system that contains /dev."""
    if uri.startswith("/dev/"):
        yield check_device("camera", uri, root)
    elif is_program_uri(uri):
        yield run_check("camera", lambda what: _check_program(what, uri, root))


def _check_program(what: str, uri: str, root: Path) -> Finding:
    """Check that the program that reads a camera is installed. For a Raspberry Pi camera on a ribbon cable, also check
    its devices, and that the program lists the camera."""
    from edgevpr.frames.programs import require_program  # loads FFmpeg

    program = require_program(uri)
    if uri.startswith("gst:"):
        return report_ok(what, FindingCode.FILE_USABLE, path=program)
    for pattern in _LIBCAMERA_DEVICES:
        for file in sorted((root / "dev").glob(pattern)):
            device = check_device(what, f"/{file.relative_to(root)}", root)
            if not device.ok:
                return device
    try:
        listing = subprocess.run([program, "--list-cameras"], capture_output=True, text=True, timeout=_LIST_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return report_fault(what, FindingCode.CAMERA_LIST_HANGS, program=program)
    cameras = dict(_CAMERA_LINE.findall(listing.stdout + listing.stderr))
    if name := cameras.get(uri.partition(":")[2] or "0"):
        return report_ok(what, FindingCode.CAMERA_LISTED, uri=uri, camera=name, program=program)
    names = ", ".join(cameras) or "none"
    return report_fault(what, FindingCode.CAMERA_NOT_LISTED, uri=uri, program=program, cameras=names)


def check_frame(what: str, config: SourceConfig) -> Finding:
    """Open the source, wait up to 65 s for a frame, and check its age. Raises ImageError if the frame does not match
    the lens calibration, SourceError if the source cannot be opened, ConfigError if the calibration cannot be used."""
    assert config.uri is not None
    lens, begin_s = load_calibrated_lens(config), time.monotonic()
    with closing(open_source(config.uri, live=True)) as source:
        size, state = _read_size(source), source.state
        facts, age_s = source.facts, source.latency_s
    if size is None:
        waited_s = time.monotonic() - begin_s
        return report_fault(what, FindingCode.NO_FRAME, uri=config.uri, state=state, waited_s=waited_s)
    if age_s is not None and age_s > MAX_FIX_AGE_S:
        return report_fault(what, FindingCode.FRAMES_LATE, uri=config.uri, age_s=age_s, limit_s=MAX_FIX_AGE_S)
    frame: dict[str, float | str | None] = {"width": size[0], "height": size[1], "age_s": age_s}
    frame["facts"] = str(facts) if facts else None
    frame["lens"] = lens.path if lens else None
    frame["fov_deg"] = compute_lens_view(lens, size).fov_deg if lens else None
    return report_ok(what, FindingCode.FRAME_RECEIVED, uri=config.uri, state=state, **frame)


def _read_size(source: Source) -> tuple[int, int] | None:
    """Wait up to 65 s for a frame; return its width and height in pixels (None: no frame arrived)."""
    begin_s = time.monotonic()
    is_failed = False
    while not (is_failed or source.ended) and time.monotonic() < begin_s + FRAME_WAIT_S:
        is_failed = source.condition in _FRAMELESS_CONDITIONS  # read first: a last frame may still be queued
        try:
            frame = source.read(0.25)
        except ImageError:
            if source.is_live:  # the frame is intact, but a flight would refuse it
                raise
            continue
        if frame:
            height, width = frame.image.shape[:2]
            return width, height
    return None
