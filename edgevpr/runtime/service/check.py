"""`edgevpr check`: would this configuration fly? Everything is opened as `edgevpr run` opens it, and closed again."""

import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.confidence.stored import not_calibrated
from edgevpr.config import Config, load_config
from edgevpr.errors import EdgevprError, ImageError, LinkError, MapError, UsageError
from edgevpr.frames.condition import Condition
from edgevpr.frames.overlay import FEWEST_FRAMES, learn_overlay, require_png, write_mask
from edgevpr.frames.source import Source, open_source
from edgevpr.helpers.files import require_folder
from edgevpr.mavlink.address import parse_links
from edgevpr.mavlink.signing import read_key
from edgevpr.mavlink.transport import open_transport
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapfiles import map_path
from edgevpr.power.boards import load_board
from edgevpr.power.equations import parse_pack
from edgevpr.runtime.flight.autopilot import DRY_RUN
from edgevpr.runtime.preflight.choose import too_late
from edgevpr.runtime.preflight.pick import outlook
from edgevpr.runtime.recognise.calibrated import calibration_of
from edgevpr.runtime.recognise.learn import check_positions
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.types import FIX_MAX_AGE_S

_LOG_ROOM_MB = 10  # some hours of queries
# Pictures that a mask is learnt from: so far apart that the ground has moved, and of a minute of flight at most.
_LEARNT_FROM, _APART_S = 3 * FEWEST_FRAMES, 0.5


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was checked; `message` says what it is or, in one sentence, what is wrong with it."""

    what: str
    ok: bool
    message: str


def check(config_path: str | Path) -> list[Finding]:
    """Check everything that a flight needs; never raises for an error that the user can correct."""
    try:
        config = load_config(config_path)
    except EdgevprError as error:
        return [Finding("configuration", False, str(error))]
    findings = [
        Finding("configuration", True, str(config_path)),
        _looked_at("board", _board, config),
        _looked_at("battery", _battery, config),
    ]
    if all(finding.ok for finding in findings):
        findings.append(_looked_at("map", _map, config))
    else:
        findings.append(Finding("map", False, "Not looked at: correct the board or the battery first."))
    findings += [_looked_at("source", _source, config), _looked_at("link", _link, config)]
    return [*findings, _looked_at("log", _log, config)]


def learn_mask(config_path: str | Path, out: Path, recording: str | None = None) -> str:
    """Learn which part of the frames shows no ground, from the configured source or a `recording`, and write the mask
    to `out`. Return a sentence about it. Raises an EdgevprError where there is nothing to learn from."""
    require_png(out)
    require_folder(out)
    uri = recording or load_config(config_path).source.uri
    if uri is None:
        raise UsageError("There is no source to learn a mask from: name a recording with --source.")
    source = open_source(uri, step_s=_APART_S, live=recording is None)
    try:
        allowed = learn_overlay(_pictures(source), uri)
    finally:
        source.close()
    if allowed.all():
        return f"{uri} shows no display over the ground: no mask is needed, and none was written."
    write_mask(out, allowed)
    return (
        f"{out}: {1 - allowed.mean():.1%} of the frame is masked. Look at it, use it as `source: {{mask: {out}}}`, and "
        f"build the map with --mask {out}."
    )


def _pictures(source: Source) -> Iterator[np.ndarray]:
    """Yield pictures of a source, `_APART_S` seconds apart where it is live, as long as any come and enough were
    yielded."""
    end_s = time.monotonic() + 2 * _LEARNT_FROM * _APART_S
    count = 0
    while count < _LEARNT_FROM and not source.ended and time.monotonic() < end_s:
        try:
            frame = source.read(1.0)
        except ImageError:
            continue
        if frame is None:
            continue
        count += 1
        yield frame.image
        if source.is_live:
            time.sleep(_APART_S)


def _looked_at(what: str, look: Callable[[Config], str], config: Config) -> Finding:
    try:
        return Finding(what, True, look(config))
    except EdgevprError as error:
        return Finding(what, False, str(error))
    except OSError as error:
        return Finding(what, False, f"{error.filename}: {error.strerror}: check the path and its permissions.")


def _board(config: Config) -> str:
    board = load_board(config.board)
    return f"{board.title}, {board.cores} cores, up to {board.memory_max_mb:.0f} MB for edgevpr"


def _battery(config: Config) -> str:
    pack = parse_pack(config.battery.pack)
    return f"{pack.cells} cells in series, {pack.capacity_mah} mAh"


def _map(config: Config) -> str:
    if config.mapping.learn and config.map is not None:
        path = map_path(config.map).absolute()
        # The map is neither made nor opened for writing, for the same reason as the log in `_log`.
        if not os.access(path.parent, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
            raise MapError(f"{path} or its folder may not be written by this user: learning needs both.")
        if not path.exists():
            return f"{path}, to be made by the first flight"
        with PlaceMap.open(path) as place_map:
            if not len(place_map):
                return f"{path}, empty so far"
    recogniser = open_recogniser(config, load_board(config.board))
    with recogniser.place_map as place_map:
        found = outlook(recogniser, config)
        sure = ""
        if recogniser.rule.sure:
            calibration = calibration_of(place_map)
            sure = f"; {calibration.said() if calibration else not_calibrated(len(place_map))}"
    if config.mavlink.link and config.mavlink.send_fixes and (found.t_query_s or 0.0) > FIX_MAX_AGE_S:
        raise UsageError(
            f"No fix would ever be sent ({too_late(found.t_query_s)}): use a faster board, fewer places or candidates, "
            f"or a technique that costs less; {found.reason}."
        )
    return f"{config.map}, {found.reason}{sure}"


def _source(config: Config) -> str:
    if config.source.uri is None:
        raise UsageError("There is no source of frames: write `source: {uri: ...}`.")
    if config.mapping.learn:
        check_positions(config, None)
    source = open_source(config.source.uri, live=True)
    # Wait until FFmpeg has given up (5 s at most): a capture that returns while Python ends aborts the process.
    while source.condition is Condition.OPENING:
        time.sleep(0.05)
    state = source.state
    source.close()
    return f"{config.source.uri}, {state}"


def _link(config: Config) -> str:
    addresses = [each for each in parse_links(config.mavlink.link, config.mavlink.ground) if each]
    if not addresses:
        return "none, so what is recognised goes into the log only"
    for address in addresses:
        try:
            open_transport(address).close()
        except OSError as error:
            raise LinkError(
                f"{address} is not there ({error.strerror}): connect it or start the other end, or correct the link."
            ) from error
    said = [str(address) for address in addresses]
    if config.mavlink.signing_key is not None:
        read_key(config.mavlink.signing_key)  # the time is not looked at, for the same reason as the log in `_log`
        said.append("signed")
    return ", ".join(said if config.mavlink.send_fixes else [*said, DRY_RUN])


def _log(config: Config) -> str:
    if config.log.path is None:
        return "none, so nothing of the flight is kept"
    # Unlike all else, the log is not opened: a check as root would leave a file that the service may not write.
    path = Path(config.log.path).absolute()
    if path.is_dir() or not path.parent.is_dir():
        raise UsageError(f"{path} is no file in a folder that is there: correct `log: {{path: ...}}`.")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise UsageError(f"{path} may not be written by this user: change its permissions or `log: {{path: ...}}`.")
    free_mb = shutil.disk_usage(path.parent).free / 1e6
    if free_mb < _LOG_ROOM_MB:
        raise UsageError(f"{path}: only {free_mb:.1f} MB are free there, {_LOG_ROOM_MB} are needed: make room.")
    return str(path)
