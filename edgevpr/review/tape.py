"""Plays back the tape of a recorded flight, for `replay`: the code's reads of the outside world (clock, frame,
temperature) return the values that they returned in the flight, and its link receives what it received then.

`runtime.flight.boundary` defines what is on the tape."""

import json
import logging
from base64 import b64decode
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, cast

from edgevpr.core.arrays import Image
from edgevpr.core.errors import EdgevprError, ImageError
from edgevpr.core.types import Frame, Position
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import Source
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.conversation import Conversation
from edgevpr.mavlink.driver import PortState
from edgevpr.mavlink.fixes import FixTransmission
from edgevpr.mavlink.ports import LINK_LOST
from edgevpr.mavlink.signing import Signing
from edgevpr.mavlink.turns import Turns
from edgevpr.mavlink.wire import Message
from edgevpr.review.compare import PacketComparison
from edgevpr.runtime.flight.boundary import LINK, SOURCE_STATE_DEFAULTS, Tape
from edgevpr.runtime.flight.stop import StopNow

Note = list[Any]  # a line of the tape: a kind and its values
_CLOCKS = ("mono_s", "wall_s", "utc_s", "process_cpu_s", "thread_cpu_s")

_log = logging.getLogger(__name__)


class TapeEnded(BaseException):
    """Raised at the end of the tape: the flight was killed there, or its recording ended before the flight."""


class ReplayedDriver:
    """A driver without a port or a thread: the turns of the link come from the tape, a `Playback`."""

    def __init__(self, playback: "Playback", _: LinkAddress, conversation: Conversation, turns: Turns) -> None:
        self._playback, self._conversation, self._turns = playback, conversation, turns
        self._outgoing: deque[FixTransmission] = deque()

    def start(self) -> None:
        """Let the playback perform the link's turns from now on."""
        self._playback.perform_turn = self._perform

    def state(self) -> PortState:
        """Return the state that the port had in the flight."""
        connected, trouble, *_ = self._playback.read("port", lambda: (False, None))  # older tapes have a third value
        return connected, trouble

    def wake(self) -> None:
        """Do nothing: the tape determines when packets are sent."""

    def close(self) -> None:
        """Do nothing: the steps of closing are on the tape."""

    def _perform(self, t_s: float, steps: list[Note]) -> None:
        """Repeat the `steps` of a turn at the time `t_s`."""
        with self._turns.freeze_clock(t_s):
            for step in steps:
                self._repeat(step, t_s)

    def _repeat(self, step: Note, now_s: float) -> None:
        conversation = self._conversation
        match step:
            case ["waits"]:
                conversation.drop_stale()
            case ["answers"]:
                conversation.announce_changes()
            case ["heard", data, sender, verdicts]:
                if verdicts:
                    conversation.settings.signing.verdicts = verdicts
                try:
                    conversation.handle(b64decode(data), now_s, tuple(sender) if sender else None)
                except Exception:  # as in the flight, where the link was lost
                    _log.debug("the link failed", exc_info=True)
            case ["said", flown]:
                packet, transmission = conversation.next_packet() or (None, None)
                self._outgoing += [transmission] if transmission else []
                self._playback.packets.compare(now_s, b64decode(flown) if flown else None, packet)
            case ["departed", count]:
                departed = [self._outgoing.popleft() for _ in range(min(count, len(self._outgoing)))]
                for transmission in departed:
                    transmission.settle(True)
                conversation.count_sent_fixes(departed)
            case ["lost" | "closed" as event, *count]:
                for transmission in self._outgoing:
                    transmission.settle(False, LINK_LOST)
                self._outgoing.clear()
                conversation.handle_port_loss(*count) if event == "lost" else conversation.end()
            case _:
                raise EdgevprError(f"The recording has an unknown link event, {step}: use the version that made it.")


class ReplayedSigning(Signing):
    """Signing without the key: signs nothing, and accepts the messages that the flight accepted. `verdicts`: for each
    of the next messages, why the flight refused it (None: it accepted it)."""

    def admits(self, message: Message) -> bool:
        """Return True if the flight accepted this message's signature."""
        reason = self.verdicts.pop(0) if self.verdicts else None
        if reason:
            self.refused[reason] += 1
        return reason is None


class ReplayedSource(Source):
    """The source of a recorded flight: its frames and attributes (see `Source`) come from the tape. `picture` returns
    the picture stored under a number, uint8 (H, W, 3) BGR or (H, W) grey."""

    def __init__(self, tape: Tape, picture: Callable[[int], Image]) -> None:
        self.is_live, self.total = tape.read("is_live", lambda: False), 0
        self._tape, self._picture = tape, picture

    def __getattr__(self, name: str) -> Any:
        if name not in SOURCE_STATE_DEFAULTS:
            raise AttributeError(name)
        value: Any = self._tape.read(name, lambda: SOURCE_STATE_DEFAULTS[name])
        return Condition[value] if name == "condition" else value

    def read(self, timeout_s: float) -> Frame | None:
        fields: Any = self._tape.read("frame", lambda: None)
        if fields is None:
            return None
        self.step_s = fields.pop("step_s", None)
        if problem := fields.get("problem"):
            raise ImageError(problem)
        number, position = fields.pop("number"), fields.pop("position")
        return Frame(image=self._picture(number), position=position and Position(**position), **fields)


class Playback(Tape):
    """Plays back a tape. `perform_turn` performs a turn of the link, given its time and steps (None: the link has not
    started); turns keep the order of the tape. `packets` compares the packets sent with those of the flight.

    Code that has changed since the flight may read more, less, or in another order. A read that has no value on the
    tape before the next frame returns the newest value of its kind, which keeps code and tape synchronised. `guessed`
    counts the reads out of order; if it is 0, the replay read exactly what the flight read."""

    def __init__(self, notes: Iterable[Note]) -> None:
        self.perform_turn: Callable[[float, list[Note]], None] | None = None
        self.packets = PacketComparison()
        self.guessed = 0
        self.t_s = 0.0  # time of the newest turn or clock reading
        self._notes, self._index = list(notes), 0
        self._newest_values: dict[str, Any] = {}
        self._is_stopping = False

    def read(self, kind: str, measure: Callable[[], Any]) -> Any:
        """Return the value of `kind` that the flight read here. `measure` reads the real machine; it is called only if
        the tape has no value. Raises StopNow where the flight was stopped, and TapeEnded."""
        if self._peek_kind() == "stopped":
            self._index += 1
            self._is_stopping = True
        # A stopped flight may have read more values while it cleaned up: they are returned first.
        if self._is_stopping and self._peek_kind() != kind:
            self._is_stopping = False
            raise StopNow
        if self._peek_kind() != kind:
            self.guessed += 1
            if not self._has_answer(kind):
                return self._guess(kind, measure)
            while self._peek_kind() not in (kind, "stopped"):
                self._index += 1
        head, *values = self._notes[self._index]
        self._index += 1
        if head == "stopped":
            raise StopNow
        value = self._newest_values[kind] = values[0]
        if _is_time(kind):
            self.t_s = max(self.t_s, value)
        return value

    def sleep(self, seconds: float) -> None:
        """Return immediately: the time comes from the tape."""

    def _peek_kind(self) -> str:
        """Perform the link's turns next on the tape; return the kind of the note after them. Raises TapeEnded."""
        while self._index < len(self._notes):
            note = self._notes[self._index]
            if note[0] != LINK or self.perform_turn is None:
                return cast(str, note[0])
            self._index += 1
            self.t_s = max(self.t_s, note[1])
            self.perform_turn(note[1], note[2])
        raise TapeEnded

    def _has_answer(self, kind: str) -> bool:
        """Return True if a value of `kind`, or the end of the flight, comes before the next frame. Return False for a
        clock, because no notes are skipped to read one."""
        end_kinds = (kind, "stopped", "frame")
        first = next((note[0] for note in islice(self._notes, self._index, None) if note[0] in end_kinds), None)
        return first in (kind, "stopped") and kind not in _CLOCKS

    def _guess(self, kind: str, measure: Callable[[], Any]) -> Any:
        if kind == "frame":
            raise TapeEnded
        if _is_time(kind):
            return self.t_s
        if kind in _CLOCKS:
            return self._newest_values.get(kind, 0.0)
        return self._newest_values[kind] if kind in self._newest_values else measure()


def _is_time(kind: str) -> bool:
    """Return True if values of `kind` are times on the flight's monotonic clock."""
    return kind == "mono_s" or kind.startswith("turn: ")


def read_tape(path: Path) -> Iterator[Note]:
    """Yield the notes of a tape file, up to a truncated line. Raises OSError if the file cannot be read."""
    with open(path, "rb") as file:
        for line in file:
            try:
                note = json.loads(line)
            except ValueError:
                return
            yield note
