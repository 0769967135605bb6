"""`edgevpr top`: show once a second the status file of the flight on this computer."""

import shutil
import sys
import textwrap
import time
from argparse import Namespace
from contextlib import suppress
from typing import Any

from edgevpr.cli.shared import add_command, add_json, print_result
from edgevpr.core.errors import EdgevprError
from edgevpr.core.reasons import read_reason
from edgevpr.core.text import escape_unprintable, format_probability

_STATUS_FILE = "/run/edgevpr/status.json"
_REFRESH_S = 1.0  # the flight writes its status once a second
_LATE_STATUS_S = 2.5  # a warning is shown for an older status; a slow frame may delay one
_STALE_STATUS_S = 10.0  # --once assumes that a flight with an older status was killed
_COARSE_AGE_S = 3.0  # the age of older pictures is shown in whole seconds
_CLEAR = "\x1b[H\x1b[J"
_CHANNELS = {"COMMAND": "command 43003", "SENSOR": "message 296"}  # other channels are shown by their own names


def add(commands: Any) -> None:
    """Add the command and its flags."""
    parser = add_command(commands, "top", run_top, "show the running flight")
    text = f"the flight's status.file (default: {_STATUS_FILE})"
    parser.add_argument("--file", default=_STATUS_FILE, metavar="PATH", help=text)
    parser.add_argument("--once", action="store_true", help="print the status once")
    add_json(parser)


def run_top(args: Namespace) -> None:
    """Run `top`: show the status of a flight until Ctrl-C; once with --once or if stdout is not a terminal."""
    from edgevpr.runtime.flight.status import read_status

    if args.once or args.json or not sys.stdout.isatty():
        status = read_status(args.file)
        if status is None or status[1] > _STALE_STATUS_S:
            raise EdgevprError(" ".join(_explain_no_flight(args.file)))
        print_result(status[0], args.json, format_status(status[0]))
        return
    with suppress(KeyboardInterrupt):
        while True:
            status = read_status(args.file)
            lines = format_status(status[0]) if status else list(_explain_no_flight(args.file))
            if status and status[1] > _LATE_STATUS_S:
                lines.insert(0, f"no status from the flight for {status[1]:.0f} s")
            columns, height = shutil.get_terminal_size()
            sys.__stdout__.write(_CLEAR)  # type: ignore[union-attr]  # bypasses the guard, which removes escapes
            rows = lines if status else [row for line in lines for row in textwrap.wrap(line, columns - 1)]
            print("\n".join(row[: columns - 1] for row in rows[: height - 1]), flush=True)
            time.sleep(_REFRESH_S)


def _explain_no_flight(file: str) -> tuple[str, str]:
    """Return two lines for the case that no flight writes its status to `file`."""
    return (
        f"No running flight writes its status to {file}:",
        "start one (edgevpr run) with `status: {file: PATH}` in its configuration, and pass that PATH with --file.",
    )


def format_status(status: dict[str, Any]) -> list[str]:
    """Return the status of a flight (see `runtime.flight.vitals`) as lines for people: a label and a text each."""
    age_s, heat = status["latency_s"], _format_optional("{:.0f} °C", status["temperature_c"])
    template = ", {:.2f} s old" if (age_s or 0) < _COARSE_AGE_S else ", newest image {:.0f} s old"
    latency = _format_optional(template, age_s)
    hot_text, throttled_text = ", hot" * bool(status["hot"]), ", throttled" * bool(status["throttled"])
    ram = f"{status['machine_ram_mb']:.0f} of {status['machine_ram_total_mb']:.0f} MB by all programs"
    rows = [
        ("edgevpr", f"{status['version']}, {status['elapsed_s']:.0f} s of flight, {status['health'].lower()}"),
        ("frames", f"{status['source']}{latency}{', paused' if status['paused'] else ''}"),
        ("rate", f"{status['asked_rate_hz']:g} queries per second"),
        ("queries", f"{status['queries']}, {status['accepted']} accepted, {status['failed']} failed"),
        ("CPU", f"{status['machine_cpu_share']:.0%} by all programs"),
        ("RAM", f"{status['rss_mb']:.0f} MB, {ram}"),
        ("heat", f"{heat or 'unknown'}{hot_text}{throttled_text}"),
        ("supply", {None: "unknown", False: "fine", True: "under-voltage"}[status["under_voltage"]]),
        ("charge", f"{status['used_mah']:.2f} mAh"),
        ("match", _format_query(status["match"], status["t_mono_s"])),
        ("newest", _format_query(status["newest"], status["t_mono_s"])),
        *(_format_link(status["link"]) if status["link"] else [("link", "none")]),
        *(("remark", remark) for remark in status["remarks"]),
    ]
    return [f"{label:<11} {escape_unprintable(text)}" for label, text in rows]


def _format_optional(template: str, value: float | None) -> str:
    return "" if value is None else template.format(value)


def _format_query(query: dict[str, Any] | None, now_s: float) -> str:
    if query is None:
        return "none yet"
    age = f"{now_s - query['t_frame_s']:.0f} s ago"
    if not query["accepted"]:
        return f"{age}, refused: {read_reason(query['reason']) or 'unknown'}"
    confidence = "" if query["confidence"] is None else f", confidence {format_probability(query['confidence'])}"
    score = _format_optional(", score {:.3f}", query["score"])
    accuracy = _format_optional(", accurate to {:.0f} m", query["accuracy_m"])
    return f"{age}, place {query['place']} ({query['reference_image']}){confidence}{score}{accuracy}"


def _format_link(link: dict[str, Any]) -> list[tuple[str, str]]:
    channel = _CHANNELS.get(link["channel"], link["channel"])
    autopilot = _format_optional(f"autopilot {{:.0f}}, positions via {channel}", link["autopilot"])
    return [
        ("link", f"{link['trouble'] or 'open'}, {autopilot or 'no telemetry from an autopilot'}"),
        ("fixes", link["fixes"]),
        ("navigation", _format_optional("position accurate to {:.1f} m", link["accuracy_m"]) or "position unknown"),
    ]
