"""A wheel of the edgevpr that runs, so that another virtual environment gets the very same, without a network."""

import base64
import filecmp
import hashlib
import zipfile
from importlib import metadata
from pathlib import Path

import edgevpr
from edgevpr.core.errors import EdgevprError
from edgevpr.core.files import shipped

_SHIPPED = ("profiles", "models", "deploy")
_OF_ONE_INSTALLATION = {"RECORD", "INSTALLER", "REQUESTED", "direct_url.json"}


def is_in(site: Path) -> bool:
    """Tell whether a folder of packages has the files of the edgevpr that runs, installed to the end."""
    whole = any(
        each.name == "edgevpr" and each.read_text("RECORD") for each in metadata.distributions(path=[str(site)])
    )
    return whole and all(
        (site / name).is_file() and filecmp.cmp(path, site / name, shallow=False) for name, path in _files().items()
    )


def write_wheel(folder: Path) -> Path:
    """Write the wheel into a folder and return its path. Raises EdgevprError where edgevpr runs without having been
    installed."""
    try:
        own = metadata.distribution("edgevpr")
    except metadata.PackageNotFoundError as error:
        raise EdgevprError("edgevpr is not installed where it runs: install it with pip first.") from error
    info = f"edgevpr-{own.version}.dist-info"
    content = {name: path.read_bytes() for name, path in _files().items()}
    for each in own.files or ():
        within = each.as_posix().partition(".dist-info/")[2]
        if within and within not in _OF_ONE_INSTALLATION:
            content[f"{info}/{within}"] = each.locate().read_bytes()
    record = "".join(f"{name},{_digest(data)},{len(data)}\n" for name, data in content.items())
    path = folder / f"edgevpr-{own.version}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as wheel:
        for name, data in content.items():
            wheel.writestr(name, data)
        wheel.writestr(f"{info}/RECORD", f"{record}{info}/RECORD,,\n")
    return path


def _files() -> dict[str, Path]:
    """Return the files of the package by their names in a wheel; those that are shipped may lie beside the package."""
    package = Path(edgevpr.__file__).parent
    folders = {"edgevpr": package} | {f"edgevpr/shipped/{kind}": shipped(kind) for kind in _SHIPPED}
    found = {
        f"{name}/{path.relative_to(folder).as_posix()}": path
        for name, folder in folders.items()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.parent.name != "__pycache__"
    }
    return found


def _digest(data: bytes) -> str:
    return "sha256=" + base64.urlsafe_b64encode(hashlib.sha256(data).digest()).decode().rstrip("=")
