"""Files that are written as a whole or not at all, and the check of their folders."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from edgevpr.errors import UsageError

T = TypeVar("T")


def require_folder(path: Path) -> None:
    """Check that the folder of a file to be written exists, before the work and not after it; else raise UsageError."""
    if not path.resolve().parent.is_dir():
        raise UsageError(f"{path}: there is no such folder: make it first.")


def write_whole(path: Path, write: Callable[[Path], T], instead: bool = True) -> T:
    """Let `write` write a temporary file, sync it to the disk, and rename it to `path`; return the result of `write`.

    If anything fails, as on a full disk, the temporary file is deleted. With `instead`, a file of that name is
    replaced; without it, FileExistsError is raised.
    """
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        result = write(unfinished)
        with open(unfinished, "rb") as handle:
            os.fsync(handle.fileno())
        if not instead:
            open(path, "x").close()  # fails if the file exists; a hard link would be atomic, but FAT has none
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return result
