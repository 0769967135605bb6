"""Files that are appended to in flight, each write as a whole or not at all."""

import errno
import fcntl
import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

MODE = 0o640  # positions are nobody else's, and a log is for the group that reads logs, whatever the umask


def open_appending(path: str | Path) -> BinaryIO:
    """Open a file, or a character device, for appending and reading; a new one gets the mode 0640. It never waits for
    anybody and has no buffer: a write that has returned is safe even if this process is killed next. Raises OSError."""
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY
    try:
        descriptor, is_new = os.open(path, flags | os.O_EXCL, MODE), True
    except FileExistsError:  # or a link to a file, which may not be there yet
        descriptor, is_new = os.open(path, flags, MODE), False
    try:
        kind = os.fstat(descriptor).st_mode
        if not (stat.S_ISREG(kind) or stat.S_ISCHR(kind)):
            raise OSError(errno.EINVAL, "it is a pipe or a disk and not a file", str(path))
        if is_new:
            with suppress(OSError):  # FAT has no permissions
                os.fchmod(descriptor, MODE)
        return os.fdopen(descriptor, "r+b", buffering=0)
    except BaseException:
        os.close(descriptor)
        raise


def append(file: BinaryIO, data: bytes) -> None:
    """Append all of `data` or, as far as the medium allows, nothing. Raises OSError."""
    end = file.seek(0, os.SEEK_END)
    try:
        rest = memoryview(data)
        while rest:  # a nearly full disk takes a part, and reports only at the next part that it is full
            taken = file.write(rest)
            if not taken:  # a terminal that is stopped
                raise OSError(errno.EAGAIN, "it takes nothing more at the moment")
            rest = rest[taken:]
    except OSError:
        with suppress(OSError):
            file.truncate(end)
        raise


def sync(file: BinaryIO) -> None:
    """Bring what was written to the disk, where there is one. Raises OSError."""
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        os.fdatasync(file.fileno())


def earlier_part(path: str | Path) -> Path:
    """Return the name under which the part before a file is kept: NAME.1.jsonl beside NAME.jsonl, with links
    followed."""
    path = Path(os.path.realpath(path))
    return path.with_name(f"{path.stem}.1{path.suffix}")


def set_aside(path: str | Path) -> None:
    """Rename a file that is full to `earlier_part`, in place of the one before. Raises OSError."""
    earlier = earlier_part(path)
    os.replace(os.path.realpath(path), earlier)
    sync_folder(earlier)


def sync_folder(path: str | Path) -> None:
    """Bring the name of a file to the disk, where the folder can be synced: with links followed, and not on FAT."""
    with suppress(OSError):
        folder = os.open(os.path.dirname(os.path.realpath(path)), os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def try_lock(file: BinaryIO) -> bool:
    """Lock an open file until it is closed. Return False where another process has it; a medium that has no locks, and
    what is no file, is locked by nobody."""
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        return True
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def is_at(file: BinaryIO, path: str | Path) -> bool:
    """Tell whether an open file is still the one that is found under `path`."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except OSError:
        return False
