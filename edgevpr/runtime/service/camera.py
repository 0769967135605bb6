"""Checks of the source of frames, for `edgevpr check` and `doctor`: the device or the program that reads the camera,
the cable, and a frame that comes and fits the lens."""

import os
import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from edgevpr.core.config import SourceConfig
from edgevpr.core.errors import ImageError, SourceError
from edgevpr.core.types import FIX_MAX_AGE_S
from edgevpr.frames.lens import sight_of
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import Source, is_by_program, open_source
from edgevpr.power import machine
from edgevpr.runtime.recognise.levelling import calibrated_lens
from edgevpr.runtime.service.finding import Finding, device, fine, looked_at, wrong

FRAME_WAIT_S = 65.0  # longer than any source takes to say that it is lost; a pipeline that starts slowly takes most
_WITHOUT_FRAMES = (Condition.LOST, Condition.FROZEN, Condition.DAMAGED, Condition.LATE)
_LIST_S = 10.0  # for the program to list the cameras
_LISTED = re.compile(r"(?m)^\s*(\d+) : (\S+)")
_BY_LIBCAMERA = ("media*", "video*", "dma_heap/*")  # devices below /dev that it opens
_BOOT = "boot/firmware/config.txt"
_ARGUS_SOURCE = "nvarguscamerasrc"
_ARGUS_SOCKET = "tmp/argus_socket"


def camera_findings(uri: str, root: Path = Path("/")) -> Iterator[Finding]:
    """Check what a live source is read with: its device, or the program and what that needs. Other sources have no
    finding. `root` is the root of the file system with /dev and /boot."""
    if uri.startswith("/dev/"):
        yield device("camera", uri, root)
    elif is_by_program(uri):
        from edgevpr.frames.programs import require_program  # loads FFmpeg

        found = looked_at("camera", lambda: require_program(uri))
        if found.ok and not uri.startswith("gst:"):
            found = _ribbon(uri, found.message, root)
        if found.ok and _ARGUS_SOURCE in uri:
            found = _argus(found.message, root)
        yield found


def _argus(program: str, root: Path) -> Finding:
    """Check the socket of the daemon that reads the ribbon camera of a Jetson."""
    if (root / _ARGUS_SOCKET).is_socket():
        return fine("camera", f"{_ARGUS_SOURCE} by {program}, its daemon listens at /{_ARGUS_SOCKET}")
    return wrong(
        "camera",
        f"/{_ARGUS_SOCKET} is not there, through which {_ARGUS_SOURCE} reads the camera: start its daemon, or pass the "
        "socket into the container; the service takes it in when it starts.",
        "sudo systemctl restart nvargus-daemon, then restart edgevpr",
    )


def _ribbon(uri: str, program: str, root: Path) -> Finding:
    """Check the devices of a camera on a Raspberry Pi's ribbon, and whether `program` lists it."""
    devices = [each for pattern in _BY_LIBCAMERA for each in sorted((root / "dev").glob(pattern))]
    for each in devices:
        if not os.access(each, os.R_OK | os.W_OK):
            return device("camera", f"/{each.relative_to(root)}", root)
    try:
        listing = subprocess.run([program, "--list-cameras"], capture_output=True, text=True, timeout=_LIST_S)
    except subprocess.TimeoutExpired:
        return wrong("camera", f"{program} --list-cameras does not end: restart the board.")
    cameras = dict(_LISTED.findall(listing.stdout + listing.stderr))
    number = uri.partition(":")[2] or "0"
    if number in cameras:
        return fine("camera", f"{uri}: {cameras[number]}, read by {program}")
    changes = ["both ends of the ribbon: the right way round, and pushed home, with the power off"]
    if "camera_auto_detect=1" not in (machine.text(root / _BOOT) or ""):
        changes.append(f"camera_auto_detect=1 in /{_BOOT}, or the dtoverlay= of your sensor, and reboot")
    others = f"only {', '.join(cameras)}" if cameras else "none"
    return wrong("camera", f"{uri} is not found: {program} --list-cameras lists {others}.", *changes)


def frame_seen(config: SourceConfig) -> str:
    """Open the source, wait for a frame, and return a text about both. Raises SourceError if no frame comes in 65 s, or
    if it is too old for a flight, ImageError if it does not fit the lens, and ConfigError for a calibration that cannot
    be used."""
    assert config.uri is not None
    lens = calibrated_lens(config)
    with closing(open_source(config.uri, live=True)) as source:
        (width, height), state = _frame_size(source, config.uri), source.state
        facts, age_s = source.facts, source.latency_s
    seen = f"{config.uri}, {state}, {width} x {height} pixels"
    if lens is not None:
        seen = f"{seen}, of which {lens.path} shows {sight_of(lens, (width, height)).fov_deg:.0f} degrees"
    if age_s is None:
        return seen
    if age_s > FIX_MAX_AGE_S:
        raise SourceError(
            f"{seen}, {age_s:.1f} s old: no fix of a picture older than {FIX_MAX_AGE_S:g} s is sent: shorten "
            "the buffers of the camera."
        )
    return f"{seen}{f', {facts}' if facts else ''}, {age_s:.1f} s old: a flight accepts it"


def _frame_size(source: Source, uri: str) -> tuple[int, int]:
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
