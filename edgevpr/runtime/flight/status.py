"""The status of a flight at one moment, and the file in which people and programs beside the flight read it: one JSON
object, replaced as a whole once a second. `vitals` writes it, the command `edgevpr top` reads it."""

import json
import os
import stat
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgevpr.core.config import build
from edgevpr.core.errors import ConfigError, EdgevprError
from edgevpr.core.text import json_line

NAME = "status.json"
_MODE = 0o660  # positions are private, but the flight's group may read them


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenQuery:
    """A query and the place found for it. `age_s` is the time since its frame was taken. `place` (its number),
    `reference_image` and `score` are None if no place was found, and `confidence` if the technique has none. The
    position and `accuracy_m` are None unless a match with a position was accepted."""

    query: str
    age_s: float
    accepted: bool
    reason: str
    place: int | None
    reference_image: str | None
    score: float | None
    confidence: float | None
    lat_deg: float | None
    lon_deg: float | None
    accuracy_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkState:
    """State of the link to the flight controller. `trouble`: why it is not open (None: it is). `autopilot`: system id
    of the autopilot heard (None: none is). `channel`: how positions are sent. `fixes`: counts of fixes in a few words.
    `answers`: counts of answers to fixes, by result; `unanswered`: count of fixes without. `accuracy_m`: how well the
    position is known (one axis, 1 sigma; None: it is not)."""

    connected: bool
    trouble: str | None
    autopilot: int | None
    channel: str
    fixes: str
    answers: dict[str, int]
    unanswered: int
    accuracy_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """Status of a flight.

    `time` is UTC, `elapsed_s` the time since the start. `health` is the state sent in heartbeats, and `source` that of
    the source of frames. `rate_hz` is the number of queries per second, and `cpu_cores` the number of cores that this
    process has kept busy, both over the last ten seconds (None: too early); `asked_rate_hz` is the rate that the flight
    tries to keep. `latency_s` is the age of the newest picture when it could be read (None: unknown).
    `machine_cpu_share` (0..1) and `machine_ram_mb` (of `machine_ram_total_mb`) are those of all programs. `throttled`:
    the board slows itself down (None: unknown). `newest` is the last query, `match` the last accepted one, `link` the
    link (None: there is none). `remarks` are sentences on what else people should know.
    """

    version: str
    time: str
    elapsed_s: float
    health: str
    paused: bool
    source: str
    latency_s: float | None
    queries: int
    accepted: int
    failed: int
    rate_hz: float | None
    asked_rate_hz: float
    cpu_cores: float | None
    rss_mb: float
    machine_cpu_share: float
    machine_ram_mb: float
    machine_ram_total_mb: float
    used_mah: float
    temperature_c: float | None
    throttled: bool | None
    newest: SeenQuery | None
    match: SeenQuery | None
    link: LinkState | None
    remarks: list[str]

    @property
    def summary(self) -> str:
        """The most important values in one line."""
        counts = f"{self.queries} queries, {self.accepted} accepted, {self.used_mah:.2f} mAh"
        return "; ".join((self.source, counts, *([self.link.fixes] if self.link else []), *self.remarks))


class StatusFile:
    """Writes the status to a file. Close it (it is a context manager), which removes the file."""

    def __init__(self, path: str | Path) -> None:
        """Try to write in the folder of `path`. Raises EdgevprError if no file can be made there."""
        self._path, self._new = Path(path), Path(f"{path}.new")
        try:
            if self._path.exists() and not stat.S_ISREG(self._path.stat().st_mode):
                raise OSError("it is there and is no file")
            self._write(b"")
            self._new.unlink()
        except OSError as error:
            raise EdgevprError(
                f"The status file {path} cannot be made ({error.strerror or error}): give a name in a folder that is "
                "there and may be written to, or none (status.file)."
            ) from error

    def __enter__(self) -> "StatusFile":
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._path.unlink()

    def tell(self, status: Status) -> None:
        """Replace the status in the file. Never raises OSError."""
        with suppress(OSError):
            self._write(json_line(status))
            os.replace(self._new, self._path)

    def _write(self, data: bytes) -> None:
        descriptor = os.open(self._new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, _MODE)
        with open(descriptor, "wb") as file:
            os.fchmod(descriptor, _MODE)  # again, since the umask may have removed bits
            file.write(data)


def read_status(path: str | Path) -> tuple[Status, float] | None:
    """Return the status in a file, and its age in seconds; None if there is no such file. Raises EdgevprError if the
    file may not be read, or holds something else."""
    try:
        with open(path, "rb") as file:
            age_s = time.time() - os.fstat(file.fileno()).st_mtime
            fields: Any = json.loads(file.read())
        return build(Status, fields, str(path)), age_s
    except FileNotFoundError:
        return None
    except OSError as error:
        raise EdgevprError(
            f"The status at {path} cannot be read ({error.strerror}): be its user or of its group (sudo), or name "
            "another file with --file."
        ) from error
    except (ValueError, TypeError, RecursionError, ConfigError) as error:
        raise EdgevprError(
            f"{path} tells no status that this edgevpr understands: use the edgevpr of the flight."
        ) from error


def usual_path() -> str | None:
    """Return the path of the status file in the folder that systemd has made for the service; None if it has made
    none."""
    folder = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    return str(Path(folder) / NAME) if folder else None
