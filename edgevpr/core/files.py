"""Files that are written as a whole or not at all, and the check of their folders; files of foreign origin, opened
only where they are files, and no larger than expected."""

import errno
import hashlib
import os
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, TypeVar

from edgevpr.core.errors import UsageError

T = TypeVar("T")
_KERNEL_FILE_BYTES = 1_000_000  # those of /proc and /sys say that they have none


def open_file(path: str | Path, most_bytes: int) -> BinaryIO:
    """Open a regular file of at most `most_bytes` for reading, without waiting for anybody.

    Raises OSError with a `strerror` fit for a sentence: also for a pipe, which would wait for a writer, for a device,
    which may never end, and for a larger file.
    """
    handle = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    try:
        said = os.fstat(handle.fileno())
        if not stat.S_ISREG(said.st_mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device and not a regular file", str(path))
        if said.st_size > most_bytes:
            size = f"it has {said.st_size / 1e6:,.1f} MB, and at most {most_bytes / 1e6:,.1f} are read"
            raise OSError(errno.EFBIG, size, str(path))
    except BaseException:
        handle.close()
        raise
    return handle


def read_file(path: str | Path, most_bytes: int) -> bytes:
    """Read a regular file of at most `most_bytes`; raises OSError as `open_file` does."""
    with open_file(path, most_bytes) as handle:
        # Never more at once than the file has: Python makes room first for all that is asked for.
        size = os.fstat(handle.fileno()).st_size or min(most_bytes, _KERNEL_FILE_BYTES)
        return handle.read(size) or b""  # None: a file of the kernel that would have to be waited for


def sha256_of(path: str | Path, most_bytes: int = sys.maxsize) -> str:
    """Compute the SHA-256 of a regular file, 64 hexadecimal digits; raises OSError as `open_file` does."""
    found = hashlib.sha256()
    with open_file(path, most_bytes) as handle:
        while block := handle.read(1 << 20):
            found.update(block)
    return found.hexdigest()


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
