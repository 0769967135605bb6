"""The systemd unit of a flight, printed by `edgevpr service print` (installation: deploy/README.md)."""

import re

from edgevpr.core.files import find_shipped
from edgevpr.core.text import escape_unprintable
from edgevpr.power.boards import Board


def render_unit(board: Board) -> str:
    """Return the text of deploy/edgevpr.service with the memory and CPU limits of a board."""
    changed = {
        "# Board: ": escape_unprintable(board.name),
        "MemoryMax=": f"{board.memory_max_mb * 1e6:.0f}",
        "CPUQuota=": f"{100 * board.cpu_share * board.cores:.0f}%",
    }
    keys = re.compile(f"(?m)^({'|'.join(changed)}).*$")
    text = (find_shipped("deploy") / "edgevpr.service").read_text(encoding="utf-8")
    return keys.sub(lambda line: line[1] + changed[line[1]], text)
