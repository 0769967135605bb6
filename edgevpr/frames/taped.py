"""A source that records its frames on a tape while they are read, and a source that replays them later. A tape records
all that comes into a flight, as values under names, and plays it back in the same order (`core.types.Tape`).

Each picture is recorded as a JPEG, and the flight itself works with the picture decoded from that JPEG. So a replay has
the flight's pictures, to the last bit.
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

from edgevpr.core.arrays import Image
from edgevpr.core.errors import ImageError
from edgevpr.core.types import Frame, Position, Tape
from edgevpr.frames.images import as_jpeg, decoded
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import Source

_UNPACKED = "image", "position", "pose"
# The attributes of a source that change, and what a replay takes them for where the tape has none.
_STATE = {
    "ended": False,
    "dropped": 0,
    "refused": {},
    "latency_s": None,
    "condition": Condition.RUNNING.name,
    "state": "replayed",
}


class RecordedSource(Source):
    """A source that records the frames of `source` on a tape, and its attributes (see `Source`) whenever one is read.
    `keep` stores the JPEG of a frame and returns the number under which it is stored."""

    def __init__(self, source: Source, tape: Tape, keep: Callable[[bytes], int]) -> None:
        self.is_live, self.total = source.is_live, source.total
        self._source, self._tape, self._keep = source, tape, keep
        tape.note("is_live", self.is_live)

    def __getattr__(self, name: str) -> Any:
        if name not in _STATE:
            raise AttributeError(name)
        value = getattr(self._source, name)
        self._tape.note(name, value.name if isinstance(value, Condition) else value)
        return value

    def read(self, timeout_s: float) -> Frame | None:
        try:
            frame = self._source.read(timeout_s)
        except ImageError as error:
            self._tape.note("frame", {"problem": str(error)} | self._step())
            raise
        if frame is None:
            self._tape.note("frame", None)
            return None
        jpeg = as_jpeg(frame.image)
        known = {name: getattr(frame, name) for name in Frame.__slots__ if name not in _UNPACKED}
        position = frame.position and asdict(frame.position)
        self._tape.note("frame", known | {"number": self._keep(jpeg), "position": position} | self._step())
        return replace(frame, image=decoded(jpeg))

    def _step(self) -> dict[str, float]:
        self.step_s = self._source.step_s
        return {} if self.step_s is None else {"step_s": self.step_s}

    def close(self) -> None:
        self._source.close()


class ReplayedSource(Source):
    """The source of a recorded flight: frames and attributes (see `Source`) come from its tape. `picture` returns the
    picture stored under a number, uint8 (H, W, 3) BGR or (H, W) grey."""

    def __init__(self, tape: Tape, picture: Callable[[int], Image]) -> None:
        self.is_live, self.total = tape.read("is_live", lambda: False), 0
        self._tape, self._picture = tape, picture

    def __getattr__(self, name: str) -> Any:
        if name not in _STATE:
            raise AttributeError(name)
        value: Any = self._tape.read(name, lambda: _STATE[name])
        return Condition[value] if name == "condition" else value

    def read(self, timeout_s: float) -> Frame | None:
        known: Any = self._tape.read("frame", lambda: None)
        if known is None:
            return None
        self.step_s = known.pop("step_s", None)
        if problem := known.get("problem"):
            raise ImageError(problem)
        number, position = known.pop("number"), known.pop("position")
        return Frame(image=self._picture(number), position=position and Position(**position), **known)
