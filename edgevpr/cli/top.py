"""`edgevpr top`: show the status of the flight on this computer, once a second, from the file that it writes."""

import json
import shutil
import sys
import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from edgevpr.cli.screen import erase_lines
from edgevpr.cli.shared import add_json, command
from edgevpr.core.errors import EdgevprError
from edgevpr.core.text import printable

if TYPE_CHECKING:
    from edgevpr.runtime.flight.status import LinkState, SeenQuery, Status

_FILE = "/run/edgevpr/status.json"
_LOOK_S = 1.0  # the flight writes its status once a second
# Age of a status after which the flight is called silent (a slow frame may delay it), and after which --once takes it
# for the last status of a flight that was killed.
_SILENT_S, _GONE_S = 2.5, 10.0
_CHANNELS = {"COMMAND": "command 43003", "SENSOR": "message 296"}  # other channels are shown by their own names

Row = tuple[str, str]


def add(commands: Any) -> None:
    """Add the command and its flags."""
    parser = command(commands, "top", run_top, "show how the flight on this computer goes")
    parser.add_argument("--file", default=_FILE, metavar="PATH", help=f"the flight's status.file ({_FILE})")
    parser.add_argument("--once", action="store_true", help="show it once, and end")
    add_json(parser)


def run_top(args: Namespace) -> int:
    """Run `top`: show the status of a flight, once or until Ctrl-C."""
    from edgevpr.runtime.flight.status import read_status

    nobody = f"no flight tells its status at {args.file}"
    if args.once:
        found = read_status(args.file)
        if found is None or found[1] > _GONE_S:
            raise EdgevprError(f"N{nobody[1:]}: start one, or name its file with --file.")
        print(_json(found[0]) if args.json else "\n".join(_table(rows(found[0]))))
        return 0
    drawn, was_silent = 0, False
    try:
        while True:
            found = read_status(args.file)
            silence = None if found else nobody
            if found and found[1] > _SILENT_S:
                silence = f"the flight has said nothing for {found[1]:.0f} s"
            if args.json or not sys.stdout.isatty():
                if found and not silence:
                    status = found[0]
                    text = f"{status.time} {_mood(status)}; {printable(status.summary)}"
                    print(_json(status) if args.json else text, flush=True)
                elif silence and not args.json and not was_silent:
                    print(silence, flush=True)
                was_silent = silence is not None
            else:
                drawn = _redraw([*filter(None, [silence]), *(_table(rows(found[0])) if found else [])], drawn)
            time.sleep(_LOOK_S)
    except KeyboardInterrupt:
        return 0


def _redraw(lines: list[str], drawn: int) -> int:
    """Print `lines` over the `drawn` lines printed before, cut to the size of the terminal. Return their number."""
    columns, height = shutil.get_terminal_size()
    erase_lines(drawn)
    lines = lines[: height - 1]
    print("\n".join(line[: columns - 1] for line in lines), flush=True)  # at once, so that nothing flickers
    return len(lines)


def rows(status: "Status") -> list[Row]:
    """Return the status for people, as rows of (label, text)."""
    rate = "-" if status.rate_hz is None else f"{status.rate_hz:.2f}"
    old = "" if status.latency_s is None else f", {status.latency_s:.2f} s old"
    cores = "-" if status.cpu_cores is None else f"{100 * status.cpu_cores:.0f}"
    ram = f"{status.machine_ram_mb:.0f} of {status.machine_ram_total_mb:.0f} MB"
    degrees = "unknown" if status.temperature_c is None else f"{status.temperature_c:.0f} °C"
    failed = f", {status.failed} failed" if status.failed else ""
    return [
        ("edgevpr", f"{status.version}, {_clock(status.elapsed_s)} of flight, {_mood(status)}"),
        ("frames", f"{status.source}{old}"),
        ("rate", f"{rate} of {status.asked_rate_hz:g} queries a second"),
        ("queries", f"{status.queries}, {status.accepted} accepted{failed}"),
        ("CPU", f"{cores} % of a core, {100 * status.machine_cpu_share:.0f} % of the machine by all programs"),
        ("RAM", f"{status.rss_mb:.0f} MB, {ram} by all programs"),
        ("heat", degrees + (", the board slows itself down" if status.throttled else "")),
        ("charge", f"{status.used_mah:.2f} mAh"),
        ("match", _match(status.match)),
        ("newest", _newest(status.newest)),
        *_link(status.link),
        *(("remark", str(remark)) for remark in status.remarks),
    ]


def _mood(status: "Status") -> str:
    return "paused" if status.paused else status.health.lower()


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 3600}:{int(seconds) // 60 % 60:02d}:{int(seconds) % 60:02d}"


def _match(match: "SeenQuery | None") -> str:
    if match is None:
        return "none yet"
    sure = f", confidence {match.confidence:.4f}" if match.confidence is not None else ""
    score = f", score {match.score:.3f}" if match.score is not None else ""
    good = f", good to {match.accuracy_m:.0f} m" if match.accuracy_m is not None else ""
    return f"{match.age_s:.0f} s ago, place {match.place} ({match.reference_image}){sure}{score}{good}"


def _newest(newest: "SeenQuery | None") -> str:
    if newest is None:
        return "none yet"
    return f"{newest.age_s:.0f} s ago, {'accepted' if newest.accepted else 'refused'}: {newest.reason}"


def _link(link: "LinkState | None") -> list[Row]:
    if link is None:
        return [("link", "none")]
    heard = "no flight controller is heard"
    if link.autopilot is not None:
        heard = f"flight controller {link.autopilot}, told by {_CHANNELS.get(link.channel, link.channel)}"
    state = link.trouble or ("open" if link.connected else "not open")
    answers = ", ".join(f"{count} {name}" for name, count in link.answers.items()) or "none"
    unanswered = f", {link.unanswered} missing" if link.unanswered else ""
    good = "position unknown" if link.accuracy_m is None else f"position known to {link.accuracy_m:.1f} m"
    return [
        ("link", f"{state}, {heard}"),
        ("fixes", link.fixes),
        ("answers", answers + unanswered),
        ("navigation", good),
    ]


def _table(table: Sequence[Row]) -> list[str]:
    return [f"{label:<11} {printable(text)}" for label, text in table]


def _json(status: "Status") -> str:
    return json.dumps(asdict(status))
