"""The status file of a flight: one JSON object, replaced as a whole once a second. `vitals` writes it and documents its
keys; the command `edgevpr top` reads it."""

import json
import os
import time
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from edgevpr import __version__
from edgevpr.core.errors import EdgevprError
from edgevpr.core.text import format_json_line

STATUS_NAME = "status.json"
_FILE_MODE = 0o660  # positions are private, but the flight's group may read them


class StatusFile(AbstractContextManager["StatusFile"]):
    """Writes the status of a flight (see `Vitals._make_status`) to a file, and removes the file at the end."""

    def __init__(self, path: str | Path) -> None:
        """Check that the file `path` can be written; `write` writes it. Raises EdgevprError if it cannot be created."""
        self._path, self._new = Path(path), Path(f"{path}.new")
        try:
            if self._path.exists() and not self._path.is_file():
                raise OSError("it exists and is not a file")
            self._write(b"")
            self._new.unlink()
        except OSError as error:
            raise EdgevprError(
                f"The status file {path} cannot be created ({error.strerror or error}): set status.file to a path in "
                "an existing, writable folder, or remove it."
            ) from error

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._path.unlink()

    def write(self, status: dict[str, Any]) -> None:
        """Replace the status in the file. Never raises OSError."""
        with suppress(OSError):
            self._write(format_json_line(status))
            os.replace(self._new, self._path)

    def _write(self, data: bytes) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
        descriptor = os.open(self._new, flags, _FILE_MODE)
        with open(descriptor, "wb") as file:
            os.fchmod(descriptor, _FILE_MODE)  # again, since the umask may have removed bits
            file.write(data)


def read_status(path: str | Path) -> tuple[dict[str, Any], float] | None:
    """Return the status in a file, and its age in seconds; None if there is none. Raises EdgevprError if it cannot be
    read, or was written by another version."""
    try:
        with open(path, "rb") as file:
            age_s = time.time() - os.fstat(file.fileno()).st_mtime
            status = json.loads(file.read())
        if status["version"] != __version__:
            raise ValueError
    except FileNotFoundError:
        return None
    except OSError as error:
        raise EdgevprError(
            f"The status file {path} cannot be read ({error.strerror}): run as its owner or in its group (or "
            "with sudo), or use another file with --file."
        ) from error
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise EdgevprError(
            f"{path} is not a status file of this version of edgevpr: use the version that runs the flight."
        ) from error
    return status, age_s


def find_default_path() -> str | None:
    """Return the path of the status file in the folder that systemd makes for the service; None if there is none."""
    folder = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    return str(Path(folder) / STATUS_NAME) if folder else None
