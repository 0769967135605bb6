"""Checks before a picture is drawn: that its file can be written, and that matplotlib is installed."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.files import require_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ENDINGS = (".png", ".pdf", ".svg")


def require_picture(path: Path) -> None:
    """Check that a picture can be written to `path`, before the work and not after it.

    Raises UsageError for a wrong file name or a missing folder, EdgevprError where matplotlib is missing.
    """
    if path.suffix.lower() not in _ENDINGS:
        raise UsageError(f"{path}: a picture's name ends in {', '.join(_ENDINGS)}: choose one of these.")
    require_folder(path)
    _hush()
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError as error:
        raise EdgevprError(f'{error}: pictures need matplotlib; pip install "edgevpr[plots]".') from error


def figure(width_in: float, height_in: float) -> "Figure":
    """Make an empty matplotlib figure; sizes in inches."""
    _hush()
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def _hush() -> None:
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # its messages about fonts are of no use to the user
