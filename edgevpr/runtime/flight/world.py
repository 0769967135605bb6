"""The world of a flight: all that comes in from outside, and all that it speaks to. In the air that is the real thing,
in a replay what is on the tape; the flight is the same."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from edgevpr.core.config import LogConfig
from edgevpr.core.types import NO_TAPE, Tape
from edgevpr.frames.source import Source
from edgevpr.mavlink.groundlink import GroundLink
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.signing import NotSigning
from edgevpr.mavlink.wire import Tap
from edgevpr.power.boards import Board
from edgevpr.runtime.flight.autopilot import Autopilot
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.herald import Herald
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.reloading import Reread
from edgevpr.runtime.flight.status import StatusFile
from edgevpr.runtime.recognise.learn import Learner
from edgevpr.runtime.recognise.recogniser import Recogniser


class StopNow(BaseException):
    """Raised to end a flight at once."""


class Stop:
    """Signal handler that ends a flight. While a frame is recognised, and before the flight begins, it ends at once, so
    that a long comparison does not delay the end; otherwise it ends after the present turn of the loop."""

    def __init__(self, tape: Tape = NO_TAPE) -> None:
        self._tape = tape
        self._asked = self._breakable = self._begins = False

    @property
    def asked(self) -> bool:
        """True where the flight is to end."""
        return self._tape.read("stop", lambda: self._asked)

    def __call__(self, *_: object) -> None:
        self._asked = True
        if self._begins:
            raise StopNow
        if self._breakable:
            self._breakable = False  # a second signal finds nothing more to break off
            self._tape.note("stopped")
            raise StopNow

    @contextmanager
    def beginning(self) -> Iterator[None]:
        """Let a signal interrupt what a flight begins with, and one that has come before it. Nothing was flown that a
        replay would have to come to."""
        self._begins = True
        try:
            if self._asked:
                raise StopNow
            yield
        finally:
            self._begins = False

    @contextmanager
    def breaks_off(self) -> Iterator[None]:
        """Let a signal interrupt the work inside this context."""
        self._breakable = True
        try:
            yield
        finally:
            self._breakable = False
        self._tape.read("went on", lambda: True)


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """The world of a flight.

    `board` and the place map at the path `place_map` (None: none is named) are what it flies with, and `log` says where
    its log goes. `tape` and `clock` give what comes in and when, `open_source` (with the seconds between two frames)
    the pictures. `link` and `ground` are the kinds of the two links, with their `signing` and `tap`. `stop` ends the
    flight, and `reread` has its configuration read again (None: it has no file). `status` is told how it goes, and
    `recording` is where it is recorded (None: nobody is told, it is not).
    """

    board: Board
    place_map: str | None
    log: LogConfig
    tape: Tape
    clock: Clock
    open_source: Callable[[float], Source]
    link: type[Link]
    ground: type[GroundLink]
    signing: NotSigning
    tap: Tap
    stop: Stop
    reread: Reread | None
    status: StatusFile | None
    recording: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Crew:
    """All that works together in a flight, opened. `learner` is None where nothing is learnt, the links where there are
    none, `reread` where the configuration has no file, and `status` where nobody is told. `fewer_candidates` are
    those that the governor may change to."""

    recogniser: Recogniser
    learner: Learner | None = None
    source: Source
    link: Link | None = None
    ground: Link | None = None
    autopilot: Autopilot
    flight_log: FlightLog
    herald: Herald
    meter: FlightMeter
    clock: Clock
    stop: Stop
    reread: Reread | None = None
    status: StatusFile | None = None
    fewer_candidates: tuple[int, ...] = ()


@contextmanager
def signals(world: World) -> Iterator[None]:
    """Let SIGTERM and SIGINT end the flight inside this context, and SIGHUP have its configuration read again."""
    handlers: dict[signal.Signals, Callable[..., None]] = {signal.SIGTERM: world.stop, signal.SIGINT: world.stop}
    if world.reread:
        handlers[signal.SIGHUP] = world.reread
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
