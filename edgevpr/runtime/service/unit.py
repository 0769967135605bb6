"""The systemd unit for a board: deploy/edgevpr.service with the board's limits and the user's configuration file."""

import re
from pathlib import Path

from edgevpr.errors import UsageError
from edgevpr.power.boards import Board
from edgevpr.resources import shipped

# ProtectHome and PrivateTmp put empty folders in their place.
_HIDDEN_FROM_THE_SERVICE = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
_RUNS = re.compile(r"(?m)^(ExecStart=.* --config )(\S+)$")


def render_unit(board: Board, config_path: str | Path | None = None) -> str:
    """Write the text of edgevpr.service for a board and a configuration file (None: the one that the shipped unit
    names). Raises UsageError for a configuration file that the service would not see."""
    text = (shipped("deploy") / "edgevpr.service").read_text(encoding="utf-8")
    usual = _RUNS.search(text)[2]
    config_path = Path(config_path or usual).absolute()
    for folder in _HIDDEN_FROM_THE_SERVICE:
        if config_path.is_relative_to(folder):
            raise UsageError(
                f"{config_path} is out of sight of the service, which has no access to {folder}: copy it to {usual}."
            )
    text = _RUNS.sub(lambda line: line[1] + _quoted(str(config_path)), text)
    for key, value in {
        "# Board: ": board.name,
        "MemoryMax=": f"{board.memory_max_mb * 1e6:.0f}",
        "CPUQuota=": f"{100 * board.cpu_share * board.cores:.0f}%",
    }.items():
        text = re.sub(f"(?m)^{re.escape(key)}.*$", lambda _, line=key + value: line, text)
    return text


def _quoted(argument: str) -> str:
    """Quote one argument of a command line in a unit: systemd.service(5), "Command lines"."""
    argument = argument.replace("%", "%%").replace("$", "$$")
    if re.search(r"[\s\"'\\]", argument):
        argument = '"' + argument.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return argument
