"""Plays back the tape of a recorded flight: the code's questions to the outside world (clock, frame, temperature) get
the answers that they got in the flight, and its links receive what they received then. `replay` uses it.

A line of the tape is a note: the answer to a question of some kind, or a turn of a link. In a turn (`mavlink.turns`) a
link works alone and its time stands still; the note has this time and the steps, such as bytes received or a packet
sent."""

import json
import logging
from base64 import b64decode
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

from edgevpr.core.errors import EdgevprError
from edgevpr.core.types import Tape
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

_RETIRED = "forms", "reread", "config"  # kinds of notes that only earlier versions wrote

_log = logging.getLogger(__name__)


class TapeEnded(BaseException):
    """Raised where the tape has no more notes: the flight was killed, or its recording ended before it did."""


class ReplayedLink(Link):
    """A link without a port and a thread, whose turns come from the tape, a `Playback`. The method `_NAME` repeats the
    step NAME of a turn."""

    def start(self) -> None:
        """Let the playback perform the link's turns from now on."""
        self._leaving: deque[Sending] = deque()
        self._playback = cast(Playback, self._tape)  # the type of `_tape` is more general
        self._playback.links[self.name] = self._perform

    def close(self) -> None:
        """Send waiting texts without delay; all else that closing does is on the tape."""
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
    """The link to the ground station, replayed as `ReplayedLink` is."""


class ReplayedSigning(NotSigning):
    """Signing without the real key: signs with a key of zeros, and admits the messages that the flight admitted.
    `verdicts` has, for each of the next messages, why the flight refused it (None: it did not)."""

    def __init__(self) -> None:
        self._refused: Counter[str] = Counter()
        self.refused = self._refused
        self.verdicts: deque[str | None] = deque()

    def of_ground(self) -> "ReplayedSigning":
        """Return the signing of the link to the ground station."""
        return ReplayedSigning()

    def stamp(self, packer: mavlink.MAVLink) -> None:
        """Make `packer` sign its next message, with a key of zeros."""
        signing = packer.signing
        signing.sign_outgoing, signing.secret_key, signing.link_id, signing.timestamp = True, bytes(KEY_BYTES), 1, 1

    def admits(self, message: Message) -> bool:
        """Return True if the flight accepted this message's signature."""
        reason = self.verdicts.popleft() if self.verdicts else None
        if reason:
            self._refused[reason] += 1
        return reason is None


class Playback(Tape):
    """A tape that is played back. `links` has, by the name of a link, the function that performs its turns; they are
    performed in the order of the tape. `packets` compares the packets sent. `link` and `ground` are the classes of the
    links that a replay uses.

    Code that has changed since the flight may ask more, less, or in another order. A question without an answer before
    the tape's next frame then gets the newest answer of its kind, so code and tape stay together. `guessed` counts the
    questions out of order; if it is 0, the replay has asked exactly what the flight asked.
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
        """Return the flight's answer to a question of `kind`. `look` asks the real machine: it is called only if the
        tape has no answer. Raises StopNow where the flight was stopped, and TapeEnded."""
        if self._head()[0] == "stopped":
            self._ahead.popleft()
            self._is_stopping = True
        # A flight that was stopped may have asked more while it cleaned up: such a question is answered first.
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

    def sleep(self, seconds: float) -> None:
        """Return at once: the time comes from the tape."""

    def _head(self) -> Note:
        """Perform the turns that come next on the tape, and return the answer after them, still on the tape. Raises
        TapeEnded."""
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
        """Take the next answer off the tape. Raises StopNow if it says that the flight was stopped, and TapeEnded."""
        note = self._head()
        self._ahead.popleft()
        if note[0] == "stopped":
            raise StopNow
        return note

    def _steps_to(self, kind: str) -> int | None:
        """Count the answers before the next one of `kind`; None if it does not come before the next frame. None for
        clocks as well: no answers are skipped to read a clock."""
        steps = 0
        for note in self._upcoming() if kind not in _CLOCKS else ():
            if note[0] in (kind, "stopped"):
                return steps
            if note[0] == "frame":
                return None
            steps += note[0] not in self.links
        return None

    def _upcoming(self) -> Iterator[Note]:
        """Yield the notes ahead. The caller may take the first one off the tape meanwhile."""
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
    """Tell whether answers of `kind` are times on the flight's monotonic clock."""
    return kind == "mono_s" or kind.startswith("turn: ")


def read_tape(path: Path) -> Iterator[Note]:
    """Yield the notes of a tape file, up to a line that was cut off. Raises EdgevprError if it cannot be read."""
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
