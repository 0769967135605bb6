"""Flight commands: `edgevpr match`, `run`, `check`, `service` and `doctor`."""

import os
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.cli import shared
from edgevpr.core.config import resolve_log_paths
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.text import progress

if TYPE_CHECKING:
    from edgevpr.runtime.recognise.recogniser import Recogniser
    from edgevpr.runtime.service.finding import Finding

_MATCHING_KEYS = (
    "board", "technique", "source.camera", "source.mask", "source.lens", "source.fov_deg", "source.up_deg",
    "match.matching", "match.form", "match.candidates", "match.sequence",
    "match.accept_precision", "match.min_score", "match.min_margin", "memory.budget_mb", "battery.pack",
    "salience.use",
)  # fmt: skip


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    match = shared.add_command(commands, "match", run_match, "look up images in a map, offline")
    match.add_argument("map", metavar="MAP")
    shared.add_recording(match)
    match.add_argument("--config", metavar="FILE", help="configuration of the flight; flags override it")
    shared.add_keys(match, *_MATCHING_KEYS)
    match.add_argument("--follow", action="store_true", help="treat the images as one flight, in order (cohog only)")
    shared.add_known(match)
    shared.add_json(match)

    run = shared.add_command(commands, "run", run_flight, "recognise places in flight, send positions to the autopilot")
    run.add_argument("--config", metavar="FILE", help="configuration file (YAML); flags override it")
    shared.add_keys(run)
    shared.add_positions(run)

    check = shared.add_command(commands, "check", run_check, "check a configuration before flight")
    check.add_argument("--config", required=True, metavar="FILE")
    check.add_argument("--offline", action="store_true", help="do not wait for a frame or a heartbeat")
    shared.add_json(check)

    services = shared.add_group(commands, "service", "print the systemd unit")
    unit = shared.add_command(services, "print", run_service_print, "print the systemd unit")
    unit.add_argument("--board", default="this", metavar="NAME", help="board of the unit (default: this computer)")

    text = "check the autopilot's parameters and this computer (read-only)"
    doctor = shared.add_command(commands, "doctor", run_doctor, text)
    doctor.add_argument("--config", metavar="FILE", help="configuration of the flight; flags override it")
    shared.add_keys(doctor, "mavlink.link")
    shared.add_json(doctor)


def run_match(args: Namespace) -> int:
    """Run `match`: look up a recording's images in a map, and print a line for each image."""
    from edgevpr.cli.matched import format_match, format_matches
    from edgevpr.frames.source import open_source, read_to_end
    from edgevpr.power.boards import load_board, resolve_board
    from edgevpr.runtime.recognise.calibration import explain_not_calibrated
    from edgevpr.runtime.recognise.evidence import list_evidence_kinds
    from edgevpr.runtime.recognise.hints import parse_known_fields
    from edgevpr.runtime.recognise.opening import open_recogniser
    from edgevpr.techniques.card import describe_weights

    config, known_fields = shared.make_config(args, args.config, map=args.map), parse_known_fields(args.known)
    board = resolve_board(load_board(config.board), config.source, config.memory)
    recogniser = open_recogniser(config, board, known=known_fields, tracks_flight=args.follow)
    matches = []
    unusable: list[ImageError] = []
    positions, upright = shared.to_path(args.positions), not recogniser.technique.spec.looks_down
    source = open_source(args.source, positions=positions, live=False, upright=upright)
    if known_fields:
        _require_known(args, known_fields, recogniser)
    frames = read_to_end(source, lambda error: shared.skip_image(error, unusable))
    place_map = recogniser.place_map
    is_calibrated = place_map.calibration is not None
    for frame in filter(None, progress(frames, source.total, "matching")):
        event = recogniser.step(frame)
        if event.failed:
            shared.skip_image(ImageError(f"{frame.name}: {event.reason}"), unusable)
            continue
        matches.append(format_match(event) | {"calibrated": is_calibrated})
        if known_fields:
            matches[-1]["hints"] = event.hints and event.hints.fields()
    lines = list(format_matches(matches))
    if not is_calibrated and list_evidence_kinds(place_map.spec):
        lines.append(f"The map is {explain_not_calibrated(place_map.spec, len(place_map))}.")
    if known_fields:
        lines.append(f"Known for each query: {','.join(known_fields)}.")
    if weights := describe_weights(recogniser.technique.spec):
        lines.append(f"Weights of {weights}.")
    shared.print_result(matches, args.json, "\n".join(lines))
    return shared.report_unusable(unusable)


def _require_known(args: Namespace, fields: Sequence[str], recogniser: "Recogniser") -> None:
    """Raise UsageError if no query, or no place of the map, has the data that --known lists."""
    from edgevpr.frames.positions import find_track, read_track
    from edgevpr.frames.source import read_tags
    from edgevpr.runtime.recognise.hints import explain_why_unusable

    source, positions = Path(args.source), shared.to_path(args.positions)
    if source.is_dir():
        queries = list(read_tags(source, positions).values())
    else:
        table = positions or find_track(source)
        queries = list(read_track(table).tags) if table else []
    if problem := explain_why_unusable(fields, queries, list(recogniser.place_map.read_places()), recogniser.sequence):
        raise UsageError(problem)


def run_flight(args: Namespace) -> int:
    """Run `run`: run a flight with a configuration until it ends."""
    from edgevpr.runtime.flight.flight import fly

    config = shared.make_config(args, args.config)
    log = resolve_log_paths(config.log, os.environ.get("LOGS_DIRECTORY", ""))
    return fly(replace(config, log=log), shared.to_path(args.positions))


def run_check(args: Namespace) -> int:
    """Run `check`: check whether a flight with a configuration can start, and print the findings."""
    from edgevpr.runtime.service.check import check_configuration

    return _show_findings(check_configuration(args.config, offline=args.offline), args.json)


def run_doctor(args: Namespace) -> int:
    """Run `doctor`: check the autopilot and this computer, and print what is right, and what to change."""
    from edgevpr.mavlink.address import parse_link
    from edgevpr.runtime.service.doctor import check_setup

    config = shared.make_config(args, args.config)
    if config.mavlink.link is None:
        raise UsageError("No link to the autopilot is configured: pass one with --link, or in --config.")
    address = parse_link(config.mavlink.link)
    findings, reading = check_setup(config, address)
    return _show_findings(findings, args.json, link=str(address), reading=reading and asdict(reading))


def _show_findings(findings: "Sequence[Finding]", as_json: bool, **extra_fields: Any) -> int:
    """Print the findings (in JSON together with `extra_fields`) and return the exit code."""
    from edgevpr.runtime.service.finding import format_findings

    is_ok, fields = all(finding.ok for finding in findings), [finding.fields() for finding in findings]
    shared.print_result({**extra_fields, "ok": is_ok, "findings": fields}, as_json, format_findings(findings))
    return max(finding.exit_code for finding in findings)


def run_service_print(args: Namespace) -> None:
    """Run `service print`: print the systemd unit for a board."""
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.service.unit import render_unit

    print(render_unit(load_board(args.board)), end="")
