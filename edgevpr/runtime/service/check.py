"""`edgevpr check`: checks whether a configuration is ready to fly, by opening and closing all that `run` opens."""

import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from edgevpr.core.config import Config, MavlinkConfig, SourceConfig, load_config
from edgevpr.core.errors import ConfigError, EdgevprError, UsageError
from edgevpr.core.reasons import ReasonCode
from edgevpr.core.text import show_progress
from edgevpr.core.types import MAX_FIX_AGE_S
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import find_missing_cause, is_live, open_source, read_intervals
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.requestlink import RequestLink
from edgevpr.mavlink.signing import open_signing
from edgevpr.power.boards import Board, load_board, resolve_board
from edgevpr.power.machine import read_model
from edgevpr.runtime.flight.startup import apply_recorded_rate
from edgevpr.runtime.preflight.pick import describe_accuracy, explain_technique, measure_query
from edgevpr.runtime.recognise.calibration import explain_not_calibrated, read_calibration_for
from edgevpr.runtime.recognise.levelling import load_calibrated_lens
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.runtime.service.camera import FRAME_WAIT_S, check_frame
from edgevpr.runtime.service.doctor import explain_silence
from edgevpr.runtime.service.finding import Finding, check_log, report_error, report_fault, report_ok, run_check
from edgevpr.runtime.service.findingcodes import FindingCode

_FRAME_SIZE_PX = 640, 480  # of the image with which a query is measured, unless a lens calibration has its size


def check_configuration(config_path: str | Path, *, offline: bool = False) -> list[Finding]:
    """Check everything that a flight needs, and return a finding for each part. Waits for a frame from the source and a
    heartbeat from the autopilot; if `offline`, only checks that source and link can be opened."""
    try:
        config = load_config(config_path)
    except EdgevprError as error:
        return [report_error("configuration", error)]
    source = apply_recorded_rate(config.source, read_intervals(config.source.uri))
    findings = [report_ok("configuration", FindingCode.FILE_USABLE, path=str(config_path))]
    try:
        board = resolve_board(load_board(config.board), source, config.memory)
        findings.append(report_ok("board", FindingCode.BOARD_KNOWN, board=board.title, memory_mb=board.memory_max_mb))
        findings.append(run_check("map", lambda what: _check_map(what, config, board)))
    except ConfigError as error:  # the map is opened within the limits of the board
        findings.append(report_error("board", error))
    show_progress("opening the source" if offline else f"waiting up to {FRAME_WAIT_S:g} s for a frame from the source")
    findings.append(run_check("source", lambda what: _check_source(what, source, offline)))
    show_progress("waiting for the flight controller")
    findings.append(run_check("link", lambda what: _check_link(what, config.mavlink, offline)))
    show_progress("")
    return [*findings, run_check("log", lambda what: check_log(what, config.log.path))]


def _check_map(what: str, config: Config, board: Board) -> Finding:
    lens = load_calibrated_lens(config.source)
    recogniser = open_recogniser(config, board, uses_hints=True)
    with closing(recogniser.place_map) as place_map:
        t_query_s = measure_query(recogniser, lens.size_px if lens else _FRAME_SIZE_PX)
        technique, confidence = explain_technique(recogniser, is_named=config.technique is not None), None
        if recogniser.rule.confidence_rule:
            calibration = read_calibration_for(place_map)
            confidence = (
                calibration.describe() if calibration else explain_not_calibrated(place_map.spec, len(place_map))
            )
    settings, machine = config.mavlink, read_model() or "this machine"
    if not board.is_this_machine():
        machine += f", not on {board.title}"
    if settings.link and settings.send_fixes and t_query_s and t_query_s > MAX_FIX_AGE_S:
        times = {"t_query_s": t_query_s, "limit_s": MAX_FIX_AGE_S}
        return report_fault(what, FindingCode.QUERY_TOO_SLOW, machine=machine, **times)
    accuracy = describe_accuracy(recogniser.technique)
    facts = {"technique": technique, "accuracy": accuracy, "confidence": confidence, "machine": machine}
    return report_ok(what, FindingCode.MAP_READY, path=config.map, t_query_s=t_query_s, rate_hz=board.rate_hz, **facts)


def _check_source(what: str, settings: SourceConfig, offline: bool) -> Finding:
    uri = settings.uri
    if uri is None:
        return replace(report_fault(what, FindingCode.NO_SOURCE), exit_code=UsageError.exit_code)
    if not offline:
        return check_frame(what, settings)
    load_calibrated_lens(settings)
    if is_live(uri) and (cause := find_missing_cause(uri)):
        return report_fault(what, FindingCode.CAMERA_ABSENT, problem=cause)
    with closing(open_source(uri, live=True)) as source:
        # Wait until FFmpeg gives up (at most 10 s): a capture that returns while Python exits aborts the process.
        while source.condition is Condition.OPENING:
            time.sleep(0.05)
        return report_ok(what, FindingCode.SOURCE_OPENED, uri=uri, state=source.state)


def _check_link(what: str, settings: MavlinkConfig, offline: bool) -> Finding:
    if settings.link is None:
        return report_ok(what, ReasonCode.NO_LINK)
    address = parse_link(settings.link)
    signing = open_signing(settings, is_read_only=True)
    with RequestLink(address, settings.component_id, settings.system_id, signing) as link:
        if not offline and link.wait_for_heartbeat() is None:
            return explain_silence(address, link)
    code = FindingCode.LINK_OPENED if settings.send_fixes else FindingCode.LINK_OPENED_DRY
    system = None if offline else link.system_id
    return report_ok(what, code, address=str(address), system=system, key=settings.signing_key)
