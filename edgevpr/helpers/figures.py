"""What every command that draws asks first: may the picture be written, and is there something to draw with."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from edgevpr.errors import EdgevprError, UsageError
from edgevpr.helpers.files import require_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ENDINGS = (".png", ".pdf", ".svg")


def require_picture(path: Path) -> None:
    """Raise UsageError or EdgevprError where no picture could be written to `path`: before the work, not after it."""
    if path.suffix.lower() not in _ENDINGS:
        raise UsageError(f"{path}: a picture's name ends in {', '.join(_ENDINGS)}: choose one of these.")
    require_folder(path)
    _hush()
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError as error:
        raise EdgevprError(f'{error}: pictures need matplotlib; pip install "edgevpr[plots]".') from error


def figure(width_in: float, height_in: float) -> "Figure":
    """An empty matplotlib figure, in inches."""
    _hush()
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def _hush() -> None:
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # its fonts are nobody's business
