"""Files: the shipped folders and the user's own; safe reading of regular files of limited size; atomic writing."""

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, TypeVar

from edgevpr.core.errors import UsageError

T = TypeVar("T")
_KERNEL_FILE_BYTES = 1_000_000  # limit for a file in /proc or /sys, where files report a size of 0


def find_shipped(kind: str) -> Path:
    """Return the folder `kind` ("profiles", "models" or "deploy") in the wheel or at the top of the checkout."""
    package = Path(__file__).parents[1]
    in_wheel = package / "shipped" / kind
    return in_wheel if in_wheel.is_dir() else package.parent / kind


def list_model_folders() -> tuple[Path, ...]:
    """Return the folders to search for a model, in order: the user's own, which may not exist (the environment variable
    EDGEVPR_MODELS, else edgevpr/models in XDG_DATA_HOME or ~/.local/share), and the shipped one."""
    # Without a home folder (a service may have none) "~" is not expanded, so no such folder is found.
    data = os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share")
    user_folder = os.environ.get("EDGEVPR_MODELS") or os.path.join(data, "edgevpr", "models")
    return Path(user_folder), find_shipped("models")


def find_model(file: str) -> Path | None:
    """Return the path of `file` in the first of `list_model_folders` that has it; None if none has, or it has a "/"."""
    paths = (folder / file for folder in list_model_folders() if "/" not in file)
    return next((path for path in paths if path.is_file()), None)


def open_file(path: str | Path, max_bytes: int) -> BinaryIO:
    """Open a regular file of at most `max_bytes` for reading, without blocking. Raises OSError, with a `strerror` that
    can end a sentence, also for a larger file, a pipe (it would wait for a writer) and a device (it may never end)."""
    handle = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    try:
        status = os.fstat(handle.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device, not a regular file", str(path))
        if status.st_size > max_bytes:
            size = f"it has {status.st_size / 1e6:,.1f} MB; the limit is {max_bytes / 1e6:,.1f} MB"
            raise OSError(errno.EFBIG, size, str(path))
    except BaseException:
        handle.close()
        raise
    return handle


def read_file(path: str | Path, max_bytes: int) -> bytes:
    """Read a regular file of at most `max_bytes`; raises OSError as `open_file` does."""
    with open_file(path, max_bytes) as handle:
        # Never request more than the file has: Python allocates the requested size first.
        size = os.fstat(handle.fileno()).st_size or min(max_bytes, _KERNEL_FILE_BYTES)
        return handle.read(size) or b""  # `read` returns None for a kernel file that has no data yet


def require_folder(path: Path) -> None:
    """Raise UsageError if the folder of the output file `path` does not exist. To be called before the work starts."""
    if not path.resolve().parent.is_dir():
        raise UsageError(f"{path}: its folder does not exist: create it first.")


def write_atomically(path: Path, write: Callable[[Path], T]) -> T:
    """Write a file completely or not at all, and return the result of `write`. `write` is called with the path of a
    temporary file and must write it; that is flushed to disk and renamed to `path`, replacing any existing file. If
    anything fails, the temporary file is deleted."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        result = write(unfinished)
        with open(unfinished, "rb") as handle:
            os.fsync(handle.fileno())
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return result
