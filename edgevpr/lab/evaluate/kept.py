"""Work that was done once and is kept: files named by the hash of all that decides their content, each with a checksum.

Two programs may write to one folder: a file appears as a whole or not at all, and whatever stands under a key is right.
"""

import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from edgevpr.core.errors import EdgevprError
from edgevpr.core.files import sha256_of

_MARK = b"edgevpr kept 1\n"
_DIGEST = 32
_UNFINISHED = "unfinished-"
_DAY_S = 86_400


def key_of(*parts: Any) -> str:
    """Return the key of work that all of `parts` decide (anything that JSON holds)."""
    said = json.dumps(parts, sort_keys=True, ensure_ascii=True, separators=(",", ":"))
    return hashlib.sha256(said.encode()).hexdigest()


class Kept:
    """A folder of finished work. `damaged` counts entries that were there and could not be believed."""

    def __init__(self, folder: str | Path) -> None:
        self.folder, self.damaged = Path(folder), 0
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise EdgevprError(f"{folder} cannot be made ({error.strerror}): name another folder.") from error

    def get(self, kind: str, key: str) -> bytes | None:
        """Return what is kept, None where nothing is or it is damaged."""
        try:
            content = self._path(kind, key).read_bytes()
        except FileNotFoundError:
            return None
        except OSError:
            self.damaged += 1
            return None
        head, body = content[: len(_MARK) + _DIGEST], content[len(_MARK) + _DIGEST :]
        if head != _MARK + hashlib.sha256(key.encode() + body).digest():
            self.damaged += 1
            return None
        return body

    def put(self, kind: str, key: str, body: bytes) -> None:
        """Keep something. Raises EdgevprError where the disk does not take it."""
        path = self._path(kind, key)
        content = _MARK + hashlib.sha256(key.encode() + body).digest() + body
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, unfinished = tempfile.mkstemp(prefix=".", dir=path.parent)
            try:
                # Not synced to the disk: what a power cut damages is noticed by its checksum, and made anew.
                with os.fdopen(handle, "wb") as file:
                    file.write(content)
                os.replace(unfinished, path)
            except BaseException:
                Path(unfinished).unlink(missing_ok=True)
                raise
        except OSError as error:
            raise self._full(error) from error

    def put_file(self, kind: str, key: str, write: Callable[[Path], None]) -> None:
        """Keep the file that `write` makes, which other programs may have open under its name."""
        try:
            self._clear_unfinished()
            with tempfile.TemporaryDirectory(prefix=_UNFINISHED, dir=self.folder) as folder:
                made = Path(folder) / "made"
                write(made)
                digest = sha256_of(made)
                path = self._file(kind, digest)
                path.parent.mkdir(parents=True, exist_ok=True)
                os.replace(made, path)
        except OSError as error:
            raise self._full(error) from error
        self.put_json(kind, key, digest)

    def get_file(self, kind: str, key: str) -> Path | None:
        """Return the path of a file that is kept; None where it is not, or is damaged."""
        if (digest := self.get_json(kind, key)) is None:
            return None
        path = self._file(kind, digest)
        with suppress(OSError):
            if sha256_of(path) == digest:
                return path
        self.damaged += 1
        return None

    def put_folder(self, kind: str, key: str, write: Callable[[Path], None]) -> Path:
        """Keep the files that `write` makes in a folder, and return where they are."""
        try:
            self._clear_unfinished()
            with tempfile.TemporaryDirectory(prefix=_UNFINISHED, dir=self.folder) as folder:
                made = Path(folder) / "made"
                made.mkdir()
                write(made)
                digests = _digests(made)
                path = self._file(kind, key_of(digests))
                path.parent.mkdir(parents=True, exist_ok=True)
                if not _holds(path, digests):
                    if path.exists():
                        os.replace(path, Path(folder) / "damaged")
                    try:
                        os.replace(made, path)
                    except OSError:  # another program may have kept the same meanwhile
                        if not _holds(path, digests):
                            raise
        except OSError as error:
            raise self._full(error) from error
        self.put_json(kind, key, digests)
        return path

    def get_folder(self, kind: str, key: str) -> Path | None:
        """Return the path of a folder that is kept; None where it is not, or a file of it is damaged or gone."""
        if (digests := self.get_json(kind, key)) is None:
            return None
        path = self._file(kind, key_of(digests))
        if _holds(path, digests):
            return path
        self.damaged += 1
        return None

    def drop(self, kind: str, key: str) -> None:
        """Forget something that is kept elsewhere now."""
        with suppress(OSError):
            self._path(kind, key).unlink()

    def get_json(self, kind: str, key: str) -> Any:
        """Return what `put_json` has kept, None where nothing is or it is damaged."""
        body = self.get(kind, key)
        return None if body is None else json.loads(body)

    def put_json(self, kind: str, key: str, value: Any) -> None:
        """Keep a value that JSON holds."""
        self.put(kind, key, json.dumps(value, separators=(",", ":")).encode())

    def size_bytes(self) -> int:
        """Return what all entries take."""
        found = 0
        for root, _, names in os.walk(self.folder):
            for name in names:
                with suppress(OSError):  # another program may have finished with it
                    found += os.lstat(os.path.join(root, name)).st_size
        return found

    def _full(self, error: OSError) -> EdgevprError:
        return EdgevprError(
            f"{self.folder} takes no more ({error.strerror}): make room, or name another --cache, and run again; all "
            "that is done stays."
        )

    def _clear_unfinished(self) -> None:
        """Delete what killed programs have left. What is younger than a day may still be at work."""
        for path in self.folder.glob(f"{_UNFINISHED}*"):
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > _DAY_S:
                    shutil.rmtree(path)

    def _file(self, kind: str, digest: str) -> Path:
        return self.folder / f"{kind}-files" / digest

    def _path(self, kind: str, key: str) -> Path:
        return self.folder / kind / key[:2] / key


def _digests(folder: Path) -> dict[str, str]:
    return {path.name: sha256_of(path) for path in sorted(folder.iterdir())}


def _holds(folder: Path, digests: dict[str, str]) -> bool:
    """Tell whether a folder holds just the files of these hashes."""
    try:
        return _digests(folder) == digests
    except OSError:
        return False
