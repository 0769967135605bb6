"""Cache on disk for the maps, results and video pictures of evaluations. Each is a file or folder that is named by the
hash of all that decides its content."""

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
    """A cache folder, with an entry (a file or folder) at KIND/KEY. Several programs may write to it at once: an entry
    appears only when it is complete."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise EdgevprError(f"{folder} cannot be made ({error.strerror}): name another folder.") from error
        # Delete unfinished entries of killed programs. Those younger than a day may still be written.
        for path in self.folder.glob(f"{_UNFINISHED}*"):
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > _DAY_S:
                    shutil.rmtree(path)

    def path(self, kind: str, key: str) -> Path:
        """Return the path of the entry of this `kind` (such as "maps") and `key`; it need not exist."""
        return self.folder / kind / key

    def keep(self, kind: str, key: str, make: Callable[[Path], object]) -> Path:
        """Return the path of the entry of this `kind` and `key`. If there is none, `make` is called first, with the
        path to write it to. Raises EdgevprError if the disk cannot be written, and what `make` raises."""
        path = self.path(kind, key)
        if path.exists():
            return path
        try:
            path.parent.mkdir(exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=_UNFINISHED, dir=self.folder) as unfinished:
                made = Path(unfinished) / "made"
                make(made)
                if not path.exists():  # another program may have made it meanwhile, and have it open
                    os.replace(made, path)
        except OSError as error:
            raise EdgevprError(
                f"{self.folder} takes no more ({error.strerror}): make room, or name another --cache, and run again; "
                "all that is done stays."
            ) from error
        return path


def key_of(*parts: Any) -> str:
    """Return the key of an entry whose content depends on `parts`, any values for JSON: their SHA-256 in hex."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


@cache
def code_of_everything() -> str:
    """Return a hash of all code that decides an answer: the package, the files it ships, the libraries' versions."""
    shipped_files = [path for kind in ("models", "profiles", "deploy") for path in shipped(kind).rglob("*")]
    return _hash_of([*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.json"), *shipped_files])


@cache
def code_of_frames() -> str:
    """Return a hash of all code that decodes a video: the package `frames`, and the versions of PyAV and others."""
    return key_of(_hash_of([*(PACKAGE / "frames").rglob("*.py")]), version_of("av"))


def _hash_of(paths: list[Path]) -> str:
    files = sorted({path for path in paths if path.is_file() and "__pycache__" not in path.parts})
    return key_of(versions(), [[path.as_posix().removeprefix(PACKAGE.as_posix()), sha256_of(path)] for path in files])
