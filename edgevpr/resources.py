"""Where the files that travel with the package are: board profiles, model cards, deployment files."""

from pathlib import Path


def shipped(kind: str) -> Path:
    """Return the folder of `kind` ("profiles", "models" or "deploy"): inside the wheel, or at the top of a checkout."""
    package = Path(__file__).parent
    in_wheel = package / "shipped" / kind
    return in_wheel if in_wheel.is_dir() else package.parent / kind
