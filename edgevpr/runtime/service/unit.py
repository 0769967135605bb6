"""The systemd unit for a board: deploy/edgevpr.service with the board's limits and the user's configuration file."""

import re
from pathlib import Path

from edgevpr.errors import UsageError
from edgevpr.power.boards import Board
from edgevpr.resources import shipped

DEFAULT_CONFIG = "/etc/edgevpr/config.yaml"
# ProtectHome and PrivateTmp put empty folders in their place.
_HIDDEN_FROM_THE_SERVICE = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")


def render_unit(board: Board, config_path: str | Path = DEFAULT_CONFIG) -> str:
    """The text of edgevpr.service. Raises UsageError for a configuration file that the service would not see."""
    config_path = Path(config_path).absolute()
    for folder in _HIDDEN_FROM_THE_SERVICE:
        if config_path.is_relative_to(folder):
            raise UsageError(
                f"{config_path} is out of sight of the service, which has no access to {folder}: "
                f"copy it to {DEFAULT_CONFIG}."
            )
    text = (shipped("deploy") / "edgevpr.service").read_text(encoding="utf-8")
    for key, value in {
        "# Board: ": board.name,
        "ExecStart=/opt/edgevpr/bin/edgevpr run --config ": _quoted(str(config_path)),
        "MemoryMax=": f"{board.memory_max_mb * 1e6:.0f}",
        "CPUQuota=": f"{100 * board.cpu_share * board.cores:.0f}%",
    }.items():
        text = re.sub(f"(?m)^{re.escape(key)}.*$", lambda _, line=key + value: line, text)
    return text


def _quoted(argument: str) -> str:
    """One argument of a command line in a unit: systemd.service(5), "Command lines"."""
    argument = argument.replace("%", "%%").replace("$", "$$")
    if re.search(r"[\s\"'\\]", argument):
        argument = '"' + argument.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return argument
