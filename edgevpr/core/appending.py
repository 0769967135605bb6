"""Log files that grow in flight: each write is complete or undone, and a full file is renamed. All may raise OSError.

Renamed files are called NAME-0001.jsonl, NAME-0002.jsonl, ... in the folder of NAME.jsonl ("numbered files" below). A
new number is one above the highest, so numbers give the order even if the aircraft's clock is wrong. Symbolic links are
followed: the numbered files are in the folder of the link's target."""

import errno
import fcntl
import os
import re
import stat
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import BinaryIO

LOG_FILE_MODE = 0o640  # regardless of the umask: positions are private, but the group that reads logs may read them
_MAX_NUMBER = 999_999  # a file name with eight digits contains a date, and is not a numbered file
_NUMBERED_NAME = re.compile(r"(.+)-(\d{4,6})", re.DOTALL)


def open_appending(path: str | Path) -> FileIO:
    """Open a file or a character device for appending and reading, without blocking. A new file gets the mode 0640. The
    result is unbuffered: once a write has returned, its data survive if this process is killed."""
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY
    try:
        descriptor, is_new = os.open(path, flags | os.O_EXCL, LOG_FILE_MODE), True
    except FileExistsError:  # a file, or a link whose target may not exist yet
        descriptor, is_new = os.open(path, flags, LOG_FILE_MODE), False
    try:
        kind = os.fstat(descriptor).st_mode
        if not (stat.S_ISREG(kind) or stat.S_ISCHR(kind)):
            raise OSError(errno.EINVAL, "it is a pipe or a disk, not a file", str(path))
        if is_new:
            with suppress(OSError):  # FAT has no permissions
                os.fchmod(descriptor, LOG_FILE_MODE)
        return os.fdopen(descriptor, "r+b", buffering=0)
    except BaseException:
        os.close(descriptor)
        raise


def append_bytes(file: BinaryIO, data: bytes) -> None:
    """Append all of `data`. If that fails, truncate the file to its old length if possible."""
    end = file.seek(0, os.SEEK_END)
    try:
        remaining = memoryview(data)
        while remaining:  # a nearly full disk accepts a part, and only the next write fails
            written = file.write(remaining)
            if not written:  # for example a stopped terminal
                raise OSError(errno.EAGAIN, "it cannot accept more data at the moment")
            remaining = remaining[written:]
    except OSError:
        with suppress(OSError):
            file.truncate(end)
        raise


def sync_file(file: BinaryIO) -> None:
    """Flush a regular file's data from the system's cache to disk; do nothing for a device."""
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        os.fdatasync(file.fileno())


def sync_folder(path: str | Path) -> None:
    """Flush the folder of the file `path` (links followed), and so the file's name, to disk. Errors are ignored."""
    with suppress(OSError):
        folder = os.open(os.path.dirname(os.path.realpath(path)), os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def try_lock(file: BinaryIO) -> bool:
    """Lock an open file until it is closed. Return False if another process holds the lock. Return True otherwise,
    including for a device or on a file system without locks."""
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            pass
    return True


def is_same_file(file: BinaryIO, path: str | Path) -> bool:
    """Return True if the open `file` is still the file at `path`, not renamed, replaced or deleted."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except OSError:
        return False


def list_numbered(path: str | Path) -> list[Path]:
    """List the numbered files of `path` (see the module docstring), lowest number first."""
    return [file for _, file in _find_numbered(Path(os.path.realpath(path)))]


def list_related(path: str | Path) -> list[Path]:
    """List the numbered files of `path`. If `path` is a numbered file itself, list those of NAME.jsonl as well."""
    path = Path(os.path.realpath(path))
    match = _NUMBERED_NAME.fullmatch(path.stem)
    return list_numbered(path) + (list_numbered(path.with_name(match[1] + path.suffix)) if match else [])


def create_numbered(path: str | Path) -> Path:
    """Create an empty file with the next number, which reserves the number for this process. Return its path."""
    path = Path(os.path.realpath(path))
    for number in range(max((number for number, _ in _find_numbered(path)), default=0) + 1, _MAX_NUMBER + 1):
        target = path.with_name(f"{path.stem}-{number:04d}{path.suffix}")
        with suppress(FileExistsError):  # another process was faster
            os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, LOG_FILE_MODE))
            return target
    raise OSError(errno.EEXIST, f"file number {_MAX_NUMBER} exists, and no higher one is allowed", str(path))


def rotate_file(path: str | Path) -> Path:
    """Rename a file to a numbered file with the next number, and return its new path."""
    target = create_numbered(path)  # FAT has no hard links, and a plain rename would replace an existing file
    try:
        os.replace(os.path.realpath(path), target)
    except OSError:
        target.unlink(missing_ok=True)
        raise
    sync_folder(target)
    return target


def delete_oldest(path: str | Path, max_bytes: float) -> bool:
    """Delete the oldest numbered files of `path` until the others have at most `max_bytes` together. Files locked by a
    process are kept. Return True if any file was deleted."""
    sizes = {}
    for file in list_numbered(path):
        with suppress(FileNotFoundError):  # another process may delete files too
            sizes[file] = os.lstat(file).st_size
    kept_bytes = before_bytes = sum(sizes.values())
    for file, size in sizes.items():
        if kept_bytes > max_bytes and _is_free(file):
            file.unlink(missing_ok=True)
            kept_bytes -= size
    return kept_bytes < before_bytes


def _find_numbered(path: Path) -> list[tuple[int, Path]]:
    files = map(path.with_name, os.listdir(path.parent))
    matches = ((_NUMBERED_NAME.fullmatch(file.stem), file) for file in files if file.suffix == path.suffix)
    return sorted((int(match[2]), file) for match, file in matches if match and match[1] == path.stem)


def _is_free(path: Path) -> bool:
    try:
        with open(path, "rb") as file:
            return try_lock(file)
    except OSError:
        return True
