"""The tape of a recorded flight, played back: every question gets the answer that it got then, and the links hear what
they heard then."""

import json
import logging
from base64 import b64decode
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

from edgevpr.core.errors import EdgevprError
from edgevpr.mavlink.fixes import Sending
from edgevpr.mavlink.groundlink import GroundLink
from edgevpr.mavlink.line import LOST
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.signing import KEY_BYTES, NotSigning
from edgevpr.mavlink.wire import Message, mavlink
from edgevpr.review.compare import Packets
from edgevpr.runtime.flight.world import StopNow

T = TypeVar("T")
Note = list[Any]  # a line of the tape: a kind, and its values
_CLOCKS = "mono_s", "wall_s", "utc_s", "process_cpu_s", "thread_cpu_s"

_RETIRED = ("forms",)  # asked by flights before, and by none now

_log = logging.getLogger(__name__)


class TapeEnded(BaseException):
    """Raised where the tape has no more: the flight was killed, or the recording had ended before it."""


class ReplayedLink(Link):
    """A link without a port and a thread: its turns are those on the tape, which is a `Playback`."""

    def start(self) -> None:
        """Take the turns of the tape from now on."""
        self._leaving: deque[Sending] = deque()
        self._playback = cast(Playback, self._tape)  # a link knows only that it has a tape
        self._playback.links[self.name] = self._perform

    def close(self) -> None:
        """Let no text wait any more; the rest is on the tape."""
        with self.turn("close"):
            self._conversation.texts.hurry()

    def _perform(self, t_s: float, steps: list[Note]) -> None:
        with self._turns.again(t_s):
            for step, *values in steps:
                try:
                    getattr(self, f"_{step}")(*values)
                except Exception:  # as in the flight, whose link went on with the next turn
                    _log.debug("a turn of the link failed", exc_info=True)

    def _waits(self) -> None:
        self._conversation.fixes.drop_stale(self._turns.now_s())

    def _answers(self) -> None:
        self._conversation.tell_of_answers()

    def _heard(self, data: str, sender: list[Any] | None, verdicts: list[str | None]) -> None:
        if verdicts:
            cast(ReplayedSigning, self._settings.signing).verdicts = deque(verdicts)
        self._conversation.hear(b64decode(data), self._turns.now_s(), (sender[0], sender[1]) if sender else None)

    def _said(self, then: str | None) -> None:
        packet, sending = self._conversation.next_packet() or (None, None)
        if sending:
            self._leaving.append(sending)
        said = then and b64decode(then)
        self._playback.packets.compare(self._turns.now_s(), self.name, said or None, packet)

    def _departed(self, count: int) -> None:
        departed = [self._leaving.popleft() for _ in range(min(count, len(self._leaving)))]
        for sending in departed:
            sending.settle(True)
        self._conversation.note_departed(departed)

    def _lost(self, count: int) -> None:
        self._throw_away()
        self._conversation.break_off(count)

    def _closed(self, count: int) -> None:
        self._throw_away()
        self._conversation.end()

    def _throw_away(self) -> None:
        for sending in self._leaving:
            sending.settle(False, LOST)
        self._leaving.clear()


class ReplayedGround(GroundLink, ReplayedLink):
    """The link to the ground, likewise."""


class ReplayedSigning(NotSigning):
    """Signs with no key that anybody has, and admits what was admitted: `verdicts` are those on the next messages, why
    each was refused (None: it was not)."""

    def __init__(self) -> None:
        self._refused: Counter[str] = Counter()
        self.refused = self._refused
        self.verdicts: deque[str | None] = deque()

    def of_ground(self) -> "ReplayedSigning":
        """Return that of the link to the ground."""
        return ReplayedSigning()

    def stamp(self, packer: mavlink.MAVLink) -> None:
        """Let a packer sign its next message."""
        signing = packer.signing
        signing.sign_outgoing, signing.secret_key, signing.link_id, signing.timestamp = True, bytes(KEY_BYTES), 1, 1

    def admits(self, message: Message) -> bool:
        """Tell whether a message was believed."""
        reason = self.verdicts.popleft() if self.verdicts else None
        if reason:
            self._refused[reason] += 1
        return reason is None


class Playback:
    """A tape that is played back. The turns of the links (`links`, by name) are taken where they were taken, and
    `packets` compares what they say. `link` and `ground` are the kinds of links that go with it.

    Code that has changed since the flight may ask more, less, or in another order. The frames then keep both in step:
    a question that has no answer before the next frame gets the newest one of its kind. `guessed` counts the questions
    out of turn; where it is 0, the replay has asked what the flight asked.
    """

    link: type[ReplayedLink] = ReplayedLink
    ground: type[GroundLink] = ReplayedGround

    def __init__(self, notes: Iterator[Note]) -> None:
        self.links: dict[str, Callable[..., None]] = {}  # each takes the time of a turn, and its steps
        self.packets = Packets()
        self.guessed = 0
        self.t_s = 0.0  # of the newest turn or look at the clock
        self._notes = notes
        self._ahead: deque[Note] = deque()
        self._known: dict[str, Any] = {}
        self._is_stopping = False

    def read(self, kind: str, look: Callable[[], T]) -> T:
        """Return the answer of the flight. Raises StopNow where the flight was ended meanwhile, and TapeEnded."""
        if self._head()[0] == "stopped":
            self._ahead.popleft()
            self._is_stopping = True
        # What was broken off may have asked, on its way out, what its undisturbed end asks.
        if self._is_stopping and self._head()[0] != kind:
            self._is_stopping = False
            raise StopNow
        if self._head()[0] != kind:
            self.guessed += 1
            steps = self._steps_to(kind)
            if steps is None:
                return cast(T, self._guess(kind, look))
            for _ in range(steps):
                self._take()
        found = self._known[kind] = self._take()[1]
        if _is_moment(kind):
            self.t_s = max(self.t_s, found)
        return cast(T, found)

    def note(self, kind: str, *values: Any) -> None:
        """Do nothing: what happens is on the tape."""

    def sleep(self, seconds: float) -> None:
        """Return at once: time goes on by the tape."""

    def _head(self) -> Note:
        """Return the next answer, after the turns of the links before it. Raises TapeEnded."""
        for note in self._upcoming():
            perform = self.links.get(note[0])
            if perform is None:
                return note
            self._ahead.popleft()
            _, t_s, steps = note
            self.t_s = max(self.t_s, t_s)
            perform(t_s, steps)
        raise TapeEnded

    def _take(self) -> Note:
        """Take the next answer off the tape. Raises StopNow where it is the end that was asked for, and TapeEnded."""
        note = self._head()
        self._ahead.popleft()
        if note[0] == "stopped":
            raise StopNow
        return note

    def _steps_to(self, kind: str) -> int | None:
        """Count the answers before the next one of a kind; None where there is none before the next frame. A look at a
        clock is not worth going on."""
        steps = 0
        for note in self._upcoming() if kind not in _CLOCKS else ():
            if note[0] in (kind, "stopped"):
                return steps
            if note[0] == "frame":
                return None
            steps += note[0] not in self.links
        return None

    def _upcoming(self) -> Iterator[Note]:
        """Yield the notes ahead, the first of which may be taken away meanwhile."""
        at = 0
        while True:
            if at == len(self._ahead):
                if (note := next(self._notes, None)) is None:
                    return
                self._ahead.append(note)
            before = len(self._ahead)
            yield self._ahead[at]
            at += len(self._ahead) == before

    def _guess(self, kind: str, look: Callable[[], Any]) -> Any:
        if kind == "frame":
            raise TapeEnded
        if _is_moment(kind):
            return self.t_s
        if kind in _CLOCKS:
            return self._known.get(kind, 0.0)
        return self._known[kind] if kind in self._known else look()


def _is_moment(kind: str) -> bool:
    """Tell whether an answer is a time on the clock of the flight."""
    return kind == "mono_s" or kind.startswith("turn: ")


def read_tape(path: Path) -> Iterator[Note]:
    """Yield the notes of a tape; a last line that was cut is left out. Raises EdgevprError where there is none."""
    try:
        with open(path, "rb") as file:
            for line in file:
                try:
                    note = json.loads(line)
                except ValueError:
                    return
                if note[0] not in _RETIRED:
                    yield note
    except OSError as error:
        raise EdgevprError(
            f"{path} cannot be read ({error.strerror}): give the log of a flight with `log.record`, and its recording."
        ) from error
