"""Files that are there as a whole or not at all, and the folders that they go into."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from edgevpr.errors import UsageError

T = TypeVar("T")


def require_folder(path: Path) -> None:
    """Raise UsageError where the folder of a file that is to be written is not there: before the work, not after it."""
    if not path.resolve().parent.is_dir():
        raise UsageError(f"{path}: there is no such folder: make it first.")


def write_whole(path: Path, write: Callable[[Path], T], instead: bool = True) -> T:
    """Let `write` write a file, which is on the disk before it has its name; returns what `write` does. A full disk is
    not left fuller. `instead` of a file of that name, or FileExistsError."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        result = write(unfinished)
        with open(unfinished, "rb") as handle:
            os.fsync(handle.fileno())
        if not instead:
            open(path, "x").close()  # never one that is there; a link would do it at once, but FAT has none
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return result
