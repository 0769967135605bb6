"""Where the files that travel with the package are: board profiles, model cards, deployment files."""

import os
from pathlib import Path


def shipped(kind: str) -> Path:
    """Return the folder of `kind` ("profiles", "models" or "deploy"): inside the wheel, or at the top of a checkout."""
    package = Path(__file__).parent
    in_wheel = package / "shipped" / kind
    return in_wheel if in_wheel.is_dir() else package.parent / kind


def own_folder() -> Path:
    """Return the user's own folder, which need not be there: edgevpr below XDG_DATA_HOME or ~/.local/share."""
    # Without a home (a service may have none) "~" stays as it is, and no such folder is found.
    return Path(os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share")) / "edgevpr"


def own_models() -> Path:
    """Return the folder of the user's own models, which need not be there: the environment's EDGEVPR_MODELS, else
    models in the user's own folder."""
    if os.environ.get("EDGEVPR_MODELS"):
        return Path(os.environ["EDGEVPR_MODELS"])
    return own_folder() / "models"


def model_folders() -> tuple[Path, ...]:
    """Return where models are looked for: the user's own folder, then the shipped one. The first of a name wins."""
    return own_models(), shipped("models")
