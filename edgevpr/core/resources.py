"""Folders of the shipped files (board profiles, model cards, deployment files) and of the user's own files."""

import os
from pathlib import Path


def shipped(kind: str) -> Path:
    """Return the folder of `kind` ("profiles", "models" or "deploy"): inside the wheel, or at the top of a checkout."""
    package = Path(__file__).parents[1]
    in_wheel = package / "shipped" / kind
    return in_wheel if in_wheel.is_dir() else package.parent / kind


def own_folder() -> Path:
    """Return the user's own folder, which may not exist: edgevpr below XDG_DATA_HOME or ~/.local/share."""
    # Without a home folder (a service may have none) "~" is not expanded, and no such folder is found.
    return Path(os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share")) / "edgevpr"


def own_models() -> Path:
    """Return the folder of the user's own models, which may not exist: the environment variable EDGEVPR_MODELS, else
    models in the user's own folder."""
    if os.environ.get("EDGEVPR_MODELS"):
        return Path(os.environ["EDGEVPR_MODELS"])
    return own_folder() / "models"


def model_folders() -> tuple[Path, ...]:
    """Return the folders that are searched for a model: the user's own, then the shipped one. The first match wins."""
    return own_models(), shipped("models")


def find_model(file: str) -> Path | None:
    """Return the path of a file in the `model_folders`, None where none has it or the name leads out of them."""
    return next((folder / file for folder in model_folders() if "/" not in file and (folder / file).is_file()), None)
