"""Files that are set aside under numbers: NAME-0001.jsonl, NAME-0002.jsonl, ... beside NAME.jsonl.

The number is one more than the highest there, so numbers say what came after what. Names have no dates: the clock of an
aircraft may be wrong. Links are followed: the numbers stand beside the file that a link leads to.
"""

import errno
import os
import re
import stat
from contextlib import suppress
from pathlib import Path

from edgevpr.core.appending import MODE, sync_folder, try_lock

MOST_FILES = 100  # a service that starts again and again must not bury the logs of flights under its own
_MOST_NUMBER = 999_999  # eight digits would be a date, and a file of somebody else
_NUMBERED = re.compile(r"(.+)-(\d{4,6})", re.DOTALL)


def numbered(path: str | Path) -> list[Path]:
    """List what has a number beside `path`, the lowest first. Raises OSError."""
    path = Path(os.path.realpath(path))
    found = {}
    for name in os.listdir(path.parent):
        each = path.with_name(name)
        match = _NUMBERED.fullmatch(each.stem)
        if match and match[1] == path.stem and each.suffix == path.suffix:
            found[each] = int(match[2])
    return sorted(found, key=found.__getitem__)


def relatives(path: str | Path) -> list[Path]:
    """List what has a number beside `path`, and beside the file that `path` was before it was set aside, if its name
    has a number. Raises OSError."""
    path = Path(os.path.realpath(path))
    match = _NUMBERED.fullmatch(path.stem)
    return numbered(path) + (numbered(path.with_name(match[1] + path.suffix)) if match else [])


def claim(path: str | Path) -> Path:
    """Make an empty file under the next number, which is then nobody else's, and return it. Raises OSError."""
    path = Path(os.path.realpath(path))
    number = max((int(_NUMBERED.fullmatch(each.stem)[2]) for each in numbered(path)), default=0)
    while number < _MOST_NUMBER:
        number += 1
        claimed = path.with_name(f"{path.stem}-{number:04d}{path.suffix}")
        try:
            os.close(os.open(claimed, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, MODE))
        except FileExistsError:  # another process was faster
            continue
        return claimed
    raise OSError(errno.EEXIST, f"there is a file of number {_MOST_NUMBER}", str(path))


def set_aside(path: str | Path) -> Path:
    """Rename a file to the next number, and return its new name. Raises OSError."""
    target = claim(path)  # FAT has no hard links, and a plain rename would replace what is there
    try:
        os.replace(os.path.realpath(path), target)
    except OSError:
        target.unlink(missing_ok=True)
        raise
    sync_folder(target)
    return target


def keep_within(path: str | Path, most_bytes: float) -> list[Path]:
    """Delete of the files that have a number beside `path` the smallest where there are more than `MOST_FILES`, then
    the oldest until they have at most `most_bytes`. One that a process writes (see `try_lock`) stays. Return what was
    deleted. Raises OSError."""
    sizes, deleted = {}, []
    for each in numbered(path):
        with suppress(FileNotFoundError):  # another process deletes as well
            found = os.lstat(each)
            if stat.S_ISREG(found.st_mode):
                sizes[each] = found.st_size

    def delete(each: Path) -> None:
        if _is_free(each):
            each.unlink(missing_ok=True)
            del sizes[each]
            deleted.append(each)

    # Of about the same size the oldest; and never the newest, whose number would be given again.
    smallest = sorted(list(sizes)[:-1], key=lambda each: sizes[each].bit_length())
    for each in smallest[: max(0, len(sizes) - MOST_FILES)]:
        delete(each)
    for each in list(sizes):
        if sum(sizes.values()) <= most_bytes:
            break
        delete(each)
    return deleted


def _is_free(path: Path) -> bool:
    try:
        with open(path, "rb") as file:
            return try_lock(file)
    except OSError:
        return True
