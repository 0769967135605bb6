"""The boundary of a flight, for recording and replay: if a flight is recorded or replayed, all input from clocks,
machine, source, link and signals passes through these classes, without any change to the flight itself.

A line of the tape is an input: a value of some kind, such as a clock reading, or a turn of the link with its time and
its steps, such as bytes received or a packet sent.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, astuple, fields, replace
from functools import partial
from typing import Any, TypeVar, cast

from edgevpr.core.errors import ImageError
from edgevpr.core.types import Frame
from edgevpr.frames.images import decode_jpeg, encode_jpeg
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import Source
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.conversation import Conversation
from edgevpr.mavlink.driver import PortDriver, PortState
from edgevpr.mavlink.turns import Turns
from edgevpr.power.meter import MachineLoad
from edgevpr.power.thermal import ThermalState
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.machine import Machine
from edgevpr.runtime.flight.stop import Stop

T = TypeVar("T")

# The attributes of a source that change, and their values in a replay if the tape lacks them.
SOURCE_STATE_DEFAULTS = {
    "ended": False,
    "dropped": 0,
    "refused": {},
    "latency_s": None,
    "condition": Condition.RUNNING.name,
    "state": "replayed",
}
# The methods of a conversation that a driver calls, and their names on the tape.
_STEPS = {
    Conversation.drop_stale.__name__: "waits",
    Conversation.announce_changes.__name__: "answers",
    Conversation.next_packet.__name__: "said",
    Conversation.count_sent_fixes.__name__: "departed",
    Conversation.handle.__name__: "heard",
    Conversation.handle_port_loss.__name__: "lost",
    Conversation.end.__name__: "closed",
}
LINK = "link"  # kind of the link's turns
_UNRECORDED_FIELDS = "image", "position", "pose"  # fields of a frame that the tape lacks, or has in another form


class Tape:
    """Records all values that enter a flight from outside, or plays a recording back. Values are JSON types or bytes.
    `kind` is the name of the input, such as "frame"."""

    def read(self, kind: str, measure: Callable[[], T]) -> T:
        """Return the result of `measure`, and record it as input `kind`; in a replay, return the recorded value."""
        raise NotImplementedError

    def note(self, kind: str, *values: Any) -> None:
        """Record values that were not read with `read`. May be called from any thread."""


def tape_clock(clock: Clock, tape: Tape) -> Clock:
    """Return the same clocks with each reading recorded on the `tape`, or played back from it."""
    names = [field.name for field in fields(clock) if field.name != "sleep"]
    return replace(clock, **{name: partial(tape.read, name, getattr(clock, name)) for name in names})


# Measurements of a machine: their names on the tape, and the types of those that are not JSON.
_MEASUREMENTS: dict[str, tuple[str, type[Any] | None]] = {
    "limit_c": ("limit_c", None),
    "measure_heat": ("heat", ThermalState),
    "measure_load": ("load", MachineLoad),
    "rss_mb": ("rss_mb", None),
    "is_written": ("log is written", None),
}


def tape_machine(machine: Machine, tape: Tape) -> Machine:
    """Return the same machine with each measurement recorded on the `tape`, or played back from it."""

    def measure(name: str, *args: Any) -> Any:
        kind, value_type = _MEASUREMENTS[name]
        if value_type is None:
            return tape.read(kind, partial(getattr(machine, name), *args))
        values = tape.read(kind, lambda: astuple(getattr(machine, name)(*args)))
        names = [field.name for field in fields(value_type)]
        return value_type(**dict(zip(names, values, strict=False)))  # an older tape may have fewer values

    return replace(machine, **{name: partial(measure, name) for name in _MEASUREMENTS})


class TapedStop(Stop):
    """Signal handler whose effects are recorded, or played back."""

    def __init__(self, tape: Tape) -> None:
        super().__init__()
        self._tape = tape

    @property
    def is_requested(self) -> bool:
        return self._tape.read("stop", lambda: super(TapedStop, self).is_requested)

    @contextmanager
    def allow_interrupt(self) -> Iterator[None]:
        with super().allow_interrupt():
            yield
        self._tape.read("went on", lambda: True)

    def _interrupt(self) -> None:
        self._tape.note("stopped")
        super()._interrupt()


class RecordedSource(Source):
    """A source that records the frames of `source`, and its attributes (see `Source`) whenever one is read.
    `store_jpeg` stores the JPEG of a frame and returns its number. The flight uses the image decoded from that JPEG, so
    a replay has exactly the images of the flight."""

    def __init__(self, source: Source, tape: Tape, store_jpeg: Callable[[bytes], int]) -> None:
        self.is_live, self.total = source.is_live, source.total
        self._source, self._tape, self._store_jpeg = source, tape, store_jpeg
        tape.note("is_live", self.is_live)

    def __getattr__(self, name: str) -> Any:
        if name not in SOURCE_STATE_DEFAULTS:
            raise AttributeError(name)
        value = getattr(self._source, name)
        self._tape.note(name, value.name if isinstance(value, Condition) else value)
        return value

    def read(self, timeout_s: float) -> Frame | None:
        try:
            frame = self._source.read(timeout_s)
        except ImageError as error:
            self._tape.note("frame", {"problem": str(error)} | self._read_step())
            raise
        if frame is None:
            self._tape.note("frame", None)
            return None
        jpeg = encode_jpeg(frame.image)
        values = {name: getattr(frame, name) for name in Frame.__slots__ if name not in _UNRECORDED_FIELDS}
        position = frame.position and asdict(frame.position)
        self._tape.note("frame", values | {"number": self._store_jpeg(jpeg), "position": position} | self._read_step())
        return replace(frame, image=decode_jpeg(jpeg))

    def _read_step(self) -> dict[str, float]:
        self.step_s = self._source.step_s
        return {} if self.step_s is None else {"step_s": self.step_s}

    def close(self) -> None:
        self._source.close()


class TapedTurns(Turns):
    """Turns that are recorded, or played back. `steps` are those of the current turn of the link."""

    def __init__(self, clock: Callable[[], float], tape: Tape) -> None:
        super().__init__(clock)
        self.tape = tape
        self.steps: list[tuple[Any, ...]] = []

    @contextmanager
    def take_link_turn(self) -> Iterator[None]:
        with super().take_link_turn():
            self.steps = []
            try:
                yield
            finally:
                if self.steps:
                    self.tape.note(LINK, self.now_s(), self.steps)

    def _begin(self, name: str) -> float:
        return self.tape.read(f"turn: {name}", partial(super()._begin, name))


class RecordedDriver(PortDriver):
    """The driver of a port that records its calls to its conversation, and its state whenever that is read."""

    def __init__(self, turns: TapedTurns, address: LinkAddress, conversation: Conversation, _: Turns) -> None:
        recorded = cast(Conversation, _RecordedConversation(conversation, turns))
        super().__init__(address, recorded, turns)
        self._tape = turns.tape

    def state(self) -> PortState:
        return self._tape.read("port", super().state)


class _RecordedConversation:
    """A conversation for a driver, whose calls are recorded as steps of the current turn."""

    def __init__(self, conversation: Conversation, turns: TapedTurns) -> None:
        self._conversation, self._turns = conversation, turns

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._conversation, name)
        return partial(self._call, _STEPS[name], value) if name in _STEPS else value

    def _call(self, step: str, method: Callable[..., Any], *args: Any) -> Any:
        result = None
        try:
            result = method(*args)
            return result
        finally:
            self._turns.steps.append((step, *self._describe(step, args, result)))

    def _describe(self, step: str, args: tuple[Any, ...], result: Any) -> tuple[Any, ...]:
        """Return the data of a call that a replay needs: bytes and their sender, the packet, the number of fixes."""
        match step, args:
            case "heard", (data, _, sender):
                return data, sender, list(self._conversation.settings.signing.verdicts)
            case "said", _:
                return (result and result[0],)
            case "departed", (fixes,):
                return (len(fixes),)
        return args
