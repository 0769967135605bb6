"""`edgevpr check`: checks whether a configuration is ready to fly. It opens everything that `edgevpr run` opens, and
closes it again."""

import time
from contextlib import closing
from pathlib import Path

from edgevpr.core.config import BatteryConfig, Config, MavlinkConfig, load_config
from edgevpr.core.errors import ConfigError, EdgevprError, LinkError, SourceError, UsageError
from edgevpr.core.text import waiting
from edgevpr.core.types import FIX_MAX_AGE_S
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import is_live, missing_cause, open_source, recorded_intervals
from edgevpr.mavlink.address import parse_links
from edgevpr.mavlink.asking import Inquiry
from edgevpr.mavlink.signing import open_signing
from edgevpr.power.boards import Board, load_board, resolve_board
from edgevpr.power.equations import parse_pack
from edgevpr.runtime.flight.autopilot import DRY_RUN
from edgevpr.runtime.flight.startup import apply_recorded_rate
from edgevpr.runtime.preflight.choose import too_late
from edgevpr.runtime.preflight.pick import explain_technique, measure_flight
from edgevpr.runtime.recognise.calibration import not_calibrated, read_calibration_for
from edgevpr.runtime.recognise.levelling import load_calibrated_lens
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.runtime.service.camera import FRAME_WAIT_S, frame_seen
from edgevpr.runtime.service.doctor import explain_silence
from edgevpr.runtime.service.finding import Finding, check_log, fine, run_check, wrong


def check(config_path: str | Path, *, offline: bool = False) -> list[Finding]:
    """Check everything that a flight needs, and return a finding for each part. It waits for a frame of the source and
    a heartbeat of the autopilot, unless `offline`: then it is enough that source and link can be opened."""
    try:
        config = load_config(config_path)
    except EdgevprError as error:
        return [wrong("configuration", str(error), exit_code=error.exit_code)]
    config = apply_recorded_rate(config, recorded_intervals(config.source.uri))
    findings = [fine("configuration", str(config_path))]
    try:
        board = resolve_board(load_board(config.board), config.source, config.memory)
        findings.append(fine("board", f"{board.title}, up to {board.memory_max_mb:.0f} MB for edgevpr"))
        findings.append(run_check("map", lambda: _check_map(config, board)))
    except ConfigError as error:  # then nothing is known of what the map would take
        findings.append(wrong("board", str(error), exit_code=error.exit_code))
    findings.append(run_check("battery", lambda: _check_battery(config.battery)))
    waiting("opening the source" if offline else f"waiting for a frame of the source, {FRAME_WAIT_S:g} s at most")
    findings.append(run_check("source", lambda: _check_source(config, offline)))
    waiting("waiting for the flight controller")
    findings.append(run_check("link", lambda: _check_link(config.mavlink, offline)))
    waiting("")
    return [*findings, check_log(config.log)]


def _check_battery(battery: BatteryConfig) -> str:
    pack = parse_pack(battery.pack)
    return f"{pack.cells} cells in series, {pack.capacity_mah} mAh"


def _check_map(config: Config, board: Board) -> str:
    recogniser = open_recogniser(config, board, narrowed=True)
    with closing(recogniser.place_map) as place_map:
        t_query_s, cost = measure_flight(recogniser)
        reason = f"{explain_technique(recogniser, is_named=config.technique is not None)}; {cost}"
        confidence = ""
        if recogniser.rule.sure:
            calibration = read_calibration_for(place_map)
            confidence = f"; {calibration.described() if calibration else not_calibrated(len(place_map))}"
    if config.mavlink.link and config.mavlink.send_fixes and t_query_s > FIX_MAX_AGE_S:
        raise EdgevprError(
            f"No fix would ever be sent ({too_late(t_query_s)}): use a faster board, fewer places or candidates, "
            f"or a technique that costs less; {reason}."
        )
    return f"{config.map}, {reason}{confidence}"


def _check_source(config: Config, offline: bool) -> str:
    uri = config.source.uri
    if uri is None:
        raise UsageError("There is no source of frames: write `source: {uri: ...}`.")
    if not offline:
        return frame_seen(config.source)
    load_calibrated_lens(config.source)
    if is_live(uri) and (cause := missing_cause(uri)):
        raise SourceError(f"The camera is not there ({cause}): connect it, or correct `source: {{uri: ...}}`.")
    with closing(open_source(uri, live=True)) as source:
        # Wait until FFmpeg has given up (10 s at most): a capture that returns while Python ends aborts the process.
        while source.condition is Condition.OPENING:
            time.sleep(0.05)
        return f"{uri}, {source.state}"


def _check_link(settings: MavlinkConfig, offline: bool) -> str:
    address, ground = parse_links(settings)
    if address is None:
        return "none: results go into the log only"
    signing = open_signing(settings, to_ask=True)
    parts = [str(address)]
    with Inquiry(address, settings.component_id, settings.system_id, signing) as inquiry:
        if not offline:
            if inquiry.heartbeat() is None:
                raise LinkError(explain_silence(address, inquiry).message)
            parts.append(f"autopilot of system {inquiry.system_id}")
    if ground:
        with Inquiry(ground, settings.component_id, settings.system_id):
            parts.append(f"ground station at {ground}")
    if settings.signing_key is not None:
        parts.append("signed")
    return ", ".join(parts if settings.send_fixes else [*parts, str(DRY_RUN)])
