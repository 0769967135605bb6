"""The systemd unit of the service: deploy/edgevpr.service with a board's limits and the user's configuration file."""

import os
import re
from pathlib import Path

from edgevpr.core.errors import UsageError
from edgevpr.core.files import shipped
from edgevpr.core.text import printable
from edgevpr.power.boards import Board

# The unit's ProtectHome and PrivateTmp show the service empty folders instead of these.
HIDDEN_FROM_THE_SERVICE = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
USUAL_CONFIG = "/etc/edgevpr/config.yaml"


def render_unit(board: Board, config_path: str | Path | None = None) -> str:
    """Return the text of edgevpr.service for a board and a configuration file (None: the one that the shipped unit
    names). Raises UsageError if the service cannot see the file, or if the unit cannot hold its name."""
    text = (shipped("deploy") / "edgevpr.service").read_text(encoding="utf-8")
    path = str(Path(config_path or USUAL_CONFIG).absolute())
    _require_visible(path)
    text = text.replace(f" --config {USUAL_CONFIG}\n", f" --config {_quoted(path)}\n")
    changed = {
        "# Board: ": printable(board.name),
        "MemoryMax=": f"{board.memory_max_mb * 1e6:.0f}",
        "CPUQuota=": f"{100 * board.cpu_share * board.cores:.0f}%",
    }
    keys = re.compile(f"(?m)^({'|'.join(changed)}).*$")
    return keys.sub(lambda line: line[1] + changed[line[1]], text)


def _require_visible(path: str) -> None:
    """Raise UsageError if the service cannot see the configuration file, or a unit cannot hold its name."""
    if not path.isprintable():  # a line break would begin a line of its own in the unit
        raise UsageError(
            f"{path} holds a character that a unit cannot hold: give it another name, e.g. {USUAL_CONFIG}."
        )
    for each in (os.path.abspath(path), os.path.realpath(path)):
        if folder := next((name for name in HIDDEN_FROM_THE_SERVICE if Path(each).is_relative_to(name)), None):
            raise UsageError(
                f"{each} is out of sight of the service, which has no access to {folder}: copy it to {USUAL_CONFIG}."
            )


def _quoted(argument: str) -> str:
    """Quote one argument of a command line in a unit, by systemd.service(5), "Command lines"."""
    argument = argument.replace("%", "%%").replace("$", "$$")
    if re.search(r"[\s\"'\\]", argument):
        argument = '"' + argument.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return argument
