"""The boundary of a flight, where recording and replay stand: what comes in from clocks, machine, source, links and
signals passes these classes, if a flight is recorded or replayed. Nothing inside knows of it.

A line of the tape is a note: the answer to a question of some kind, or a turn of a link with its time and its steps,
such as bytes received or a packet sent.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, astuple, fields, replace
from functools import partial
from typing import Any, TypeVar

from edgevpr.core.config import Config
from edgevpr.core.errors import ImageError
from edgevpr.core.types import Frame
from edgevpr.frames.images import as_jpeg, decoded
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import Source
from edgevpr.mavlink.address import LinkAddress, Sender
from edgevpr.mavlink.conversation import LinkSettings
from edgevpr.mavlink.driver import PortDriver, PortState, Wire
from edgevpr.mavlink.fixes import Sending
from edgevpr.mavlink.peer import Autopilot
from edgevpr.mavlink.turns import Turns
from edgevpr.power.boards import Board
from edgevpr.power.meter import MachineLoad
from edgevpr.power.thermal import ThermalState
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.machine import Machine
from edgevpr.runtime.flight.stop import Stop
from edgevpr.runtime.preflight.pick import Outlook
from edgevpr.runtime.recognise.recogniser import Recogniser

T = TypeVar("T")

# The attributes of a source that change, and what a replay takes them for where the tape has none.
SOURCE_STATE = {
    "ended": False,
    "dropped": 0,
    "refused": {},
    "latency_s": None,
    "condition": Condition.RUNNING.name,
    "state": "replayed",
}
_UNPACKED = "image", "position", "pose"  # of a frame, not on the tape as they are


class Tape:
    """Records all values that enter a flight from outside, or plays a recording back. Values are JSON types or bytes.
    `kind` is the name of the input, such as "frame"."""

    def read(self, kind: str, look: Callable[[], T]) -> T:
        """Get a value of the input `kind` by `look`, and record it; in a replay return the recorded value instead."""
        raise NotImplementedError

    def note(self, kind: str, *values: Any) -> None:
        """Record values that were not obtained by `read`; may be called from any thread."""


def tape_clock(clock: Clock, tape: Tape) -> Clock:
    """Return the same clocks with each reading recorded on the `tape`, or played back from it."""
    names = [each.name for each in fields(clock) if each.name != "sleep"]
    return replace(clock, **{name: partial(tape.read, name, getattr(clock, name)) for name in names})


class TapedMachine(Machine):
    """A machine whose answers are recorded, or played back."""

    def __init__(self, board: Board, tape: Tape) -> None:
        super().__init__(board)
        self._tape = tape

    def limit_c(self) -> float:
        return self._tape.read("limit_c", super().limit_c)

    def measure_heat(self) -> ThermalState:
        names = [field.name for field in fields(ThermalState)]
        values = self._tape.read("heat", lambda: astuple(super(TapedMachine, self).measure_heat()))
        return ThermalState(**dict(zip(names, values, strict=False)))  # an older tape has fewer values

    def measure_load(self) -> MachineLoad:
        load = self._tape.read("load", lambda: astuple(super(TapedMachine, self).measure_load()))
        return MachineLoad(tuple(load[0]), *load[1:])

    def rss_mb(self) -> float:
        return self._tape.read("rss_mb", super().rss_mb)

    def pick_technique(self, config: Config) -> str | None:
        return self._tape.read("picked", partial(super().pick_technique, config))

    def measure_speed(self, recogniser: Recogniser, config: Config) -> Outlook:
        measured = partial(super().measure_speed, recogniser, config)
        return Outlook(*self._tape.read("outlook", lambda: astuple(measured())))

    def try_map(self, opened: Callable[[], object]) -> str | None:
        return self._tape.read("cannot_learn", partial(super().try_map, opened))

    def is_written(self, flight_log: FlightLog) -> bool:
        return self._tape.read("log is written", partial(super().is_written, flight_log))


class TapedStop(Stop):
    """Signal handler whose effects are recorded, or played back."""

    def __init__(self, tape: Tape) -> None:
        super().__init__()
        self._tape = tape

    @property
    def asked(self) -> bool:
        return self._tape.read("stop", lambda: super(TapedStop, self).asked)

    @contextmanager
    def breaks_off(self) -> Iterator[None]:
        with super().breaks_off():
            yield
        self._tape.read("went on", lambda: True)

    def _break_off(self) -> None:
        self._tape.note("stopped")
        super()._break_off()


class RecordedSource(Source):
    """A source that records the frames of `source`, and its attributes (see `Source`) whenever one is read. `keep`
    stores the JPEG of a frame and returns the number under which it is stored. The flight works with the picture
    decoded from that JPEG, so that a replay has the flight's pictures to the last bit."""

    def __init__(self, source: Source, tape: Tape, keep: Callable[[bytes], int]) -> None:
        self.is_live, self.total = source.is_live, source.total
        self._source, self._tape, self._keep = source, tape, keep
        tape.note("is_live", self.is_live)

    def __getattr__(self, name: str) -> Any:
        if name not in SOURCE_STATE:
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


class TapedTurns(Turns):
    """Turns that are recorded, or played back. `steps` are those of the present turn of a link."""

    def __init__(self, clock: Callable[[], float], tape: Tape) -> None:
        super().__init__(clock)
        self.tape = tape
        self.steps: list[tuple[Any, ...]] = []

    @contextmanager
    def of_link(self, name: str) -> Iterator[None]:
        with super().of_link(name):
            self.steps = []
            try:
                yield
            finally:
                if self.steps:
                    self.tape.note(name, self.now_s(), self.steps)

    def _begin(self, what: str) -> float:
        return self.tape.read(f"turn: {what}", partial(super()._begin, what))


class RecordedDriver(PortDriver):
    """The driver of a port that records what it does with its conversation, and its state whenever that is read."""

    def __init__(self, turns: TapedTurns, name: str, address: LinkAddress, conversation: Wire, _: Turns) -> None:
        super().__init__(name, address, _RecordedWire(conversation, turns), turns)
        self._tape = turns.tape

    def state(self) -> PortState:
        return self._tape.read("port", super().state)


class _RecordedWire:
    """A conversation whose driver's calls are recorded as steps of the present turn."""

    def __init__(self, conversation: Wire, turns: TapedTurns) -> None:
        self._conversation, self._turns = conversation, turns

    @property
    def settings(self) -> LinkSettings:
        return self._conversation.settings

    @property
    def autopilot(self) -> Autopilot:
        return self._conversation.autopilot

    @property
    def waits(self) -> bool:
        return self._conversation.waits

    def wait_s(self, longest_s: float) -> float:
        return self._conversation.wait_s(longest_s)

    def drop_stale(self) -> None:
        self._note("waits")
        self._conversation.drop_stale()

    def announce_changes(self) -> None:
        self._note("answers")
        self._conversation.announce_changes()

    def next_packet(self) -> tuple[bytes, Sending | None] | None:
        found = self._conversation.next_packet()
        self._note("said", found and found[0])
        return found

    def note_departed(self, fixes: list[Sending]) -> None:
        self._note("departed", len(fixes))
        self._conversation.note_departed(fixes)

    def hear(self, data: bytes, now_s: float, sender: Sender | None) -> bool:
        try:
            return self._conversation.hear(data, now_s, sender)
        finally:
            self._note("heard", data, sender, list(self.settings.signing.verdicts))

    def break_off(self, lost_fixes: int) -> None:
        self._note("lost", lost_fixes)
        self._conversation.break_off(lost_fixes)

    def end(self) -> None:
        self._note("closed")
        self._conversation.end()

    def _note(self, *step: Any) -> None:
        self._turns.steps.append(step)
