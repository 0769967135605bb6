"""`edgevpr check`: checks whether a configuration is ready to fly. It opens everything that `edgevpr run` opens, and
closes it again."""

import os
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from edgevpr.core.config import Config, load_config
from edgevpr.core.errors import EdgevprError, LinkError, MapError, SourceError, UsageError
from edgevpr.core.types import FIX_MAX_AGE_S
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import is_live, missing_cause, open_source, recorded_steps
from edgevpr.mavlink.address import LinkAddress, parse_links
from edgevpr.mavlink.asking import Inquiry
from edgevpr.mavlink.signing import open_signing
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapfiles import map_path
from edgevpr.power.boards import load_board
from edgevpr.power.equations import parse_pack
from edgevpr.runtime.flight.aboard import at_recorded_rate
from edgevpr.runtime.flight.autopilot import DRY_RUN
from edgevpr.runtime.preflight.choose import too_late
from edgevpr.runtime.preflight.pick import outlook
from edgevpr.runtime.recognise.evidence import calibration_of, not_calibrated
from edgevpr.runtime.recognise.learn import check_positions
from edgevpr.runtime.recognise.levelling import calibrated_lens
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.runtime.service.camera import FRAME_WAIT_S, frame_seen
from edgevpr.runtime.service.doctor import silence
from edgevpr.runtime.service.finding import Finding, fine, log_findings, looked_at, wrong


def check(
    config_path: str | Path, *, offline: bool = False, say: Callable[[str], None] = lambda text: None
) -> list[Finding]:
    """Check everything that a flight needs, and return a finding for each part.

    The check waits for a frame of the source and a heartbeat of the autopilot, unless `offline`: then it is enough that
    source and link can be opened. `say` is called with a short text while the check waits, and with "" after it.
    """
    try:
        config = load_config(config_path)
    except EdgevprError as error:
        return [wrong("configuration", str(error), exit_code=error.exit_code)]
    config = at_recorded_rate(config, recorded_steps(config.source.uri))
    findings = [
        fine("configuration", str(config_path)),
        looked_at("board", lambda: _board(config)),
        looked_at("battery", lambda: _battery(config)),
        looked_at("map", lambda: _map(config)),
    ]
    say("opening the source" if offline else f"waiting for a frame of the source, {FRAME_WAIT_S:g} s at most")
    findings.append(looked_at("source", lambda: _source(config, offline)))
    say("waiting for the flight controller")
    findings.append(looked_at("link", lambda: _link(config, offline)))
    say("")
    return [*findings, *log_findings(config.log, has_link=config.mavlink.link is not None)]


def _board(config: Config) -> str:
    board = load_board(config.board)
    return f"{board.title}, {board.cores} cores, up to {board.memory_max_mb:.0f} MB for edgevpr"


def _battery(config: Config) -> str:
    pack = parse_pack(config.battery.pack)
    return f"{pack.cells} cells in series, {pack.capacity_mah} mAh"


def _map(config: Config) -> str:
    if config.mapping.learn and config.map is not None:
        path = map_path(config.map).absolute()
        # The map is neither made nor opened for writing: root would leave a file that the service may not write.
        if not os.access(path.parent, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
            raise MapError(f"{path} or its folder may not be written by this user: learning needs both.")
        if not path.exists():
            return f"{path}, to be made by the first flight"
        with PlaceMap.open(path) as place_map:
            if not len(place_map):
                return f"{path}, empty so far"
    recogniser = open_recogniser(config, load_board(config.board), narrowed=True)
    with closing(recogniser.place_map) as place_map:
        found = outlook(recogniser, config)
        sure = ""
        if recogniser.rule.sure:
            calibration = calibration_of(place_map)
            sure = f"; {calibration.described() if calibration else not_calibrated(len(place_map))}"
    t_query_s = found.t_query_s or 0.0
    if config.mavlink.link and config.mavlink.send_fixes and t_query_s > FIX_MAX_AGE_S:
        raise EdgevprError(
            f"No fix would ever be sent ({too_late(t_query_s)}): use a faster board, fewer places or candidates, "
            f"or a technique that costs less; {found.reason}."
        )
    return f"{config.map}, {found.reason}{sure}"


def _source(config: Config, offline: bool) -> str:
    uri = config.source.uri
    if uri is None:
        raise UsageError("There is no source of frames: write `source: {uri: ...}`.")
    if config.mapping.learn:
        check_positions(config)
    if not offline:
        return frame_seen(config.source)
    calibrated_lens(config.source)
    if is_live(uri) and (cause := missing_cause(uri)):
        raise SourceError(f"The camera is not there ({cause}): connect it, or correct `source: {{uri: ...}}`.")
    with closing(open_source(uri, live=True)) as source:
        # Wait until FFmpeg has given up (10 s at most): a capture that returns while Python ends aborts the process.
        while source.condition is Condition.OPENING:
            time.sleep(0.05)
        return f"{uri}, {source.state}"


def _link(config: Config, offline: bool) -> str:
    settings = config.mavlink
    address, ground = parse_links(settings.link, settings.ground)
    if address is None:
        return "none, so what is recognised goes into the log only"
    signing = open_signing(settings.signing_key, settings.signing_state, to_ask=True)
    with Inquiry(address, settings.component_id, settings.system_id, signing) as inquiry:
        parts = [str(address)] if offline else [str(address), _heartbeat(inquiry, address)]
    if ground:
        with Inquiry(ground, settings.component_id, settings.system_id):
            parts.append(f"ground station at {ground}")
    if settings.signing_key is not None:
        parts.append("signed")
    return ", ".join(parts if settings.send_fixes else [*parts, DRY_RUN])


def _heartbeat(inquiry: Inquiry, address: LinkAddress) -> str:
    if inquiry.heartbeat() is None:
        raise LinkError(silence(address, inquiry.reader.bad_bytes, inquiry.others, inquiry.signing.refused).message)
    return f"autopilot heard: system {inquiry.system_id}"
