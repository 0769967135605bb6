"""Checks of the source of frames, for `edgevpr check` and `doctor`: the device or the program that reads the camera,
the cable, and a first frame that fits the lens."""

import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from edgevpr.core.config import SourceConfig
from edgevpr.core.errors import ImageError, SourceError
from edgevpr.core.types import FIX_MAX_AGE_S
from edgevpr.frames.lens import line_of_sight
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import Source, is_by_program, open_source
from edgevpr.runtime.recognise.levelling import load_calibrated_lens
from edgevpr.runtime.service.finding import Finding, check_device, fine, run_check, wrong

FRAME_WAIT_S = 65.0  # longer than any source takes to report that it is lost; a pipeline that starts slowly takes most
_WITHOUT_FRAMES = (Condition.LOST, Condition.FROZEN, Condition.DAMAGED, Condition.LATE)
_LIST_S = 10.0  # for the program to list the cameras
_LISTED = re.compile(r"(?m)^\s*(\d+) : (\S+)")
_LIBCAMERA_DEVICES = ("media*", "video*", "dma_heap/*")  # below /dev


def check_camera(uri: str, root: Path = Path("/")) -> Iterator[Finding]:
    """Check what a live source is read with: its device, or the program and what that needs. Other sources have no
    finding. `root` is the root of the file system with /dev."""
    if uri.startswith("/dev/"):
        yield check_device("camera", uri, root)
    elif is_by_program(uri):
        from edgevpr.frames.programs import require_program  # loads FFmpeg

        finding = run_check("camera", lambda: require_program(uri))
        if finding.ok and not uri.startswith("gst:"):
            finding = _check_ribbon(uri, finding.message, root)
        yield finding


def _check_ribbon(uri: str, program: str, root: Path) -> Finding:
    """Check the devices of a camera on a Raspberry Pi's ribbon, and whether `program` lists it."""
    for pattern in _LIBCAMERA_DEVICES:
        for file in sorted((root / "dev").glob(pattern)):
            device = check_device("camera", f"/{file.relative_to(root)}", root)
            if not device.ok:
                return device
    try:
        listing = subprocess.run([program, "--list-cameras"], capture_output=True, text=True, timeout=_LIST_S)
    except subprocess.TimeoutExpired:
        return wrong("camera", f"{program} --list-cameras does not end: restart the board.")
    cameras = dict(_LISTED.findall(listing.stdout + listing.stderr))
    if name := cameras.get(uri.partition(":")[2] or "0"):
        return fine("camera", f"{uri}: {name}, read by {program}")
    return wrong(
        "camera",
        f"{uri} is not found: {program} --list-cameras lists {', '.join(cameras) or 'none'}.",
        "with the power off, push in both ends of the ribbon, the right way round",
        "camera_auto_detect=1, or the dtoverlay= of the sensor, in /boot/firmware/config.txt, and reboot",
    )


def frame_seen(config: SourceConfig) -> str:
    """Open the source, wait for a frame, and return a text about both. Raises SourceError if no frame comes in 65 s, or
    if it is too old for a flight, ImageError if it does not fit the lens, and ConfigError for a calibration that cannot
    be used."""
    assert config.uri is not None
    lens = load_calibrated_lens(config)
    with closing(open_source(config.uri, live=True)) as source:
        (width, height), state = _read_size(source, config.uri), source.state
        facts, age_s = source.facts, source.latency_s
    parts = [config.uri, state, f"{width} x {height} pixels"]
    if lens is not None:
        parts.append(f"of which {lens.path} shows {line_of_sight(lens, (width, height)).fov_deg:.0f} degrees")
    if age_s is not None and age_s > FIX_MAX_AGE_S:
        raise SourceError(
            f"{', '.join(parts)}, {age_s:.1f} s old: no fix of a picture older than {FIX_MAX_AGE_S:g} s is sent: "
            "shorten the buffers of the camera."
        )
    if age_s is not None:
        parts += [*([str(facts)] if facts else []), f"{age_s:.1f} s old: a flight accepts it"]
    return ", ".join(parts)


def _read_size(source: Source, uri: str) -> tuple[int, int]:
    """Wait for a frame, 65 s at most; return its width and height in pixels."""
    begin_s = time.monotonic()
    is_hopeless = False
    while not (is_hopeless or source.ended) and time.monotonic() < begin_s + FRAME_WAIT_S:
        is_hopeless = source.condition in _WITHOUT_FRAMES  # asked before the frame is read: a last one may wait
        try:
            frame = source.read(0.25)
        except ImageError:
            if source.is_live:  # not damaged, but of a kind that the flight would refuse
                raise
            continue
        if frame:
            height, width = frame.image.shape[:2]
            return width, height
    waited_s = time.monotonic() - begin_s
    raise SourceError(
        f"{uri}: no frame came in {waited_s:.0f} s ({source.state}): start the camera or the stream, or "
        "correct `source: {uri: ...}`; `edgevpr check --offline` waits for none."
    )
