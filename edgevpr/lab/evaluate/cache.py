"""Work that was done once and is kept: files and folders named by the hash of all that decides their content."""

import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from edgevpr.core.errors import EdgevprError
from edgevpr.core.files import sha256_of, shipped
from edgevpr.lab.evaluate.provenance import PACKAGE, version_of, versions

_UNFINISHED = ".unfinished-"
_DAY_S = 86_400


class Cache:
    """A folder of finished work. Two programs may write to it: whatever stands under a key is whole."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise EdgevprError(f"{folder} cannot be made ({error.strerror}): name another folder.") from error
        # What killed programs have left; what is younger than a day may still be at work.
        for path in self.folder.glob(f"{_UNFINISHED}*"):
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > _DAY_S:
                    shutil.rmtree(path)

    def path(self, kind: str, key: str) -> Path:
        """Return where the work of a kind is kept, whether it is there or not."""
        return self.folder / kind / key

    def keep(self, kind: str, key: str, make: Callable[[Path], object]) -> Path:
        """Return the path of what is kept under a key; where nothing is, `make` makes that file or folder first. Raises
        EdgevprError where the disk does not take it, and what `make` raises."""
        path = self.path(kind, key)
        if path.exists():
            return path
        try:
            path.parent.mkdir(exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=_UNFINISHED, dir=self.folder) as unfinished:
                made = Path(unfinished) / "made"
                make(made)
                if not path.exists():  # another program may have kept the same meanwhile, and have it open
                    os.replace(made, path)
        except OSError as error:
            raise EdgevprError(
                f"{self.folder} takes no more ({error.strerror}): make room, or name another --cache, and run again; "
                "all that is done stays."
            ) from error
        return path


def key_of(*parts: Any) -> str:
    """Return the key of work that all of `parts` decide (anything that JSON holds)."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


@cache
def code_of_everything() -> str:
    """Return the hash of all that makes an answer: the package, what it ships, and the versions of the libraries."""
    shipped_files = [path for kind in ("models", "profiles", "deploy") for path in shipped(kind).rglob("*")]
    return _hash_of([*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.json"), *shipped_files])


@cache
def code_of_frames() -> str:
    """Return the hash of all that takes the frames of a video: the room of the frames, and the version of PyAV."""
    return key_of(_hash_of([*(PACKAGE / "frames").rglob("*.py")]), version_of("av"))


def _hash_of(paths: list[Path]) -> str:
    files = sorted({path for path in paths if path.is_file() and "__pycache__" not in path.parts})
    return key_of(versions(), [[path.as_posix().removeprefix(PACKAGE.as_posix()), sha256_of(path)] for path in files])
