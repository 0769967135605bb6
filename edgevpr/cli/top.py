"""`edgevpr top`: how the flight on this computer goes, once a second."""

import json
import shutil
import sys
import time
from argparse import Namespace
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from edgevpr.cli.screen import erase_lines
from edgevpr.cli.shared import add_json, command
from edgevpr.core.errors import EdgevprError
from edgevpr.core.text import printable

if TYPE_CHECKING:
    from edgevpr.runtime.flight.status import LinkState, Seen, Status

_FILE = "/run/edgevpr/status.json"
_LOOK_S = 1.0  # a status comes once a second
_SILENT_S, _GONE_S = 2.5, 10.0  # a slow frame delays it; a flight that was killed leaves its last one
_CHANNELS = {"COMMAND": "command 43003", "SENSOR": "message 296"}  # the others are called as their messages

Row = tuple[str, str]


def add(commands: Any) -> None:
    """Add the command and its flags."""
    parser = command(commands, "top", run_top, "show how the flight on this computer goes")
    parser.add_argument("--file", default=_FILE, metavar="PATH", help=f"the flight's status.file ({_FILE})")
    parser.add_argument("--once", action="store_true", help="show it once, and end")
    add_json(parser)


def run_top(args: Namespace) -> int:
    """Show the status of a flight, until Ctrl-C."""
    from edgevpr.runtime.flight.status import read_status

    nobody = f"no flight tells its status at {args.file}"
    if args.once:
        found = read_status(args.file)
        if found is None or found[1] > _GONE_S:
            raise EdgevprError(f"N{nobody[1:]}: start one, or name its file with --file.")
        print(_json(found[0]) if args.json else "\n".join(_table(rows(found[0]))))
        return 0
    screen = _Json() if args.json else _Terminal() if sys.stdout.isatty() else _Lines()
    try:
        while True:
            found = read_status(args.file)
            if found is None:
                screen.show_silence(nobody, None)
            elif found[1] > _SILENT_S:
                screen.show_silence(f"the flight has said nothing for {found[1]:.0f} s", found[0])
            else:
                screen.show(found[0])
            time.sleep(_LOOK_S)
    except KeyboardInterrupt:
        return 0


def rows(status: "Status") -> list[Row]:
    """Return the status as a person reads it: labels and texts."""
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


def _match(match: "Seen | None") -> str:
    if match is None:
        return "none yet"
    sure = f", confidence {match.confidence:.4f}" if match.confidence is not None else ""
    score = f", score {match.score:.3f}" if match.score is not None else ""
    good = f", good to {match.accuracy_m:.0f} m" if match.accuracy_m is not None else ""
    return f"{match.age_s:.0f} s ago, place {match.place} ({match.reference_image}){sure}{score}{good}"


def _newest(newest: "Seen | None") -> str:
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
    from dataclasses import asdict

    return json.dumps(asdict(status))


class _Json:
    """Prints a line of JSON for every status."""

    def show(self, status: "Status") -> None:
        print(_json(status), flush=True)

    def show_silence(self, why: str, status: "Status | None") -> None:
        pass


class _Lines:
    """Prints a line for every status, and one when there is none any more."""

    def __init__(self) -> None:
        self._said = False

    def show(self, status: "Status") -> None:
        self._said = False
        print(f"{status.time} {_mood(status)}; {printable(status.summary)}", flush=True)

    def show_silence(self, why: str, status: "Status | None") -> None:
        if not self._said:
            print(why, flush=True)
        self._said = True


class _Terminal:
    """Draws the status over the one before."""

    def __init__(self) -> None:
        self._drawn = 0

    def show(self, status: "Status") -> None:
        self._draw(_table(rows(status)))

    def show_silence(self, why: str, status: "Status | None") -> None:
        self._draw([why, *(_table(rows(status)) if status else [])])

    def _draw(self, lines: list[str]) -> None:
        columns, height = shutil.get_terminal_size()
        erase_lines(self._drawn)
        lines = lines[: height - 1]
        print("\n".join(line[: columns - 1] for line in lines), flush=True)  # at once, so that nothing flickers
        self._drawn = len(lines)
