"""The world of a flight: all that it takes in from outside and sends outside. In the air these are real cameras, clocks
and links; in a replay they come from the recording's tape. The code of the flight is the same."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from edgevpr.core.config import LogConfig
from edgevpr.core.types import NO_TAPE, Tape
from edgevpr.frames.source import Source
from edgevpr.mavlink.groundlink import GroundLink
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.signing import Signing
from edgevpr.mavlink.wire import Tap
from edgevpr.power.boards import Board
from edgevpr.runtime.flight.autopilot import ToAutopilot
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.herald import Herald
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.status import StatusFile
from edgevpr.runtime.recognise.learn import Learner
from edgevpr.runtime.recognise.recogniser import Recogniser


class StopNow(BaseException):
    """Raised by a signal to end a flight at once; a BaseException, so that no handler of errors catches it."""


class Stop:
    """Signal handler that ends a flight. While a frame is recognised, and before the flight begins, it raises StopNow,
    so that a long comparison does not delay the end. Otherwise the flight ends after the present pass of its loop."""

    def __init__(self, tape: Tape = NO_TAPE) -> None:
        self._tape = tape
        self._asked = self._breakable = self._begins = False

    @property
    def asked(self) -> bool:
        """True if a signal has asked for the end of the flight."""
        return self._tape.read("stop", lambda: self._asked)

    def __call__(self, *_: object) -> None:
        self._asked = True
        if self._begins:
            raise StopNow
        if self._breakable:
            self._breakable = False  # a second signal must not raise again
            self._tape.note("stopped")
            raise StopNow

    @contextmanager
    def beginning(self) -> Iterator[None]:
        """Context manager for the start of a flight: a signal raises StopNow inside it, also a signal that came before
        it. This is not recorded, since nothing has been flown that could be replayed."""
        self._begins = True
        try:
            if self._asked:
                raise StopNow
            yield
        finally:
            self._begins = False

    @contextmanager
    def breaks_off(self) -> Iterator[None]:
        """Context manager: a signal interrupts the work inside it by StopNow."""
        self._breakable = True
        try:
            yield
        finally:
            self._breakable = False
        self._tape.read("went on", lambda: True)


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """External parts of a flight: all that it reads from and writes to. A test or a replay replaces them.
    - `place_map`: path of the map (None: none is configured); `log`: settings of the flight log
    - `tape`: records all input of the flight, or plays it back (see `Tape`); `clock`: the clocks
    - `open_source`: opens the source of frames, given the seconds between two frames
    - `link`, `ground`: classes of the links to the autopilot and to the ground station
    - `signing`: of their packets; `tap`: is called with each packet sent or received
    - `stop`: the signal handler that ends the flight
    - `status`: the status file (None: none is written); `recording`: folder of the recording (None: there is none).
    """

    board: Board
    place_map: str | None
    log: LogConfig
    tape: Tape
    clock: Clock
    open_source: Callable[[float], Source]
    link: type[Link]
    ground: type[GroundLink]
    signing: Signing
    tap: Tap
    stop: Stop
    status: StatusFile | None
    recording: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Crew:
    """All opened parts of a flight that work together. None means: `learner`, no places are learnt; `link`, `ground`
    and `autopilot`, there is no such link; `status`, no status file is written. `fewer_candidates` are the numbers of
    candidates that the governor may lower to."""

    recogniser: Recogniser
    learner: Learner | None = None
    source: Source
    link: Link | None = None
    ground: Link | None = None
    autopilot: ToAutopilot | None = None
    flight_log: FlightLog
    herald: Herald
    meter: FlightMeter
    clock: Clock
    stop: Stop
    status: StatusFile | None = None
    fewer_candidates: tuple[int, ...] = ()


@contextmanager
def signals(stop: Stop) -> Iterator[None]:
    """Context manager: SIGTERM and SIGINT call `stop` inside it. SIGHUP is ignored: a closed terminal ends no
    flight."""
    handlers: dict[signal.Signals, Stop | signal.Handlers] = {signal.SIGTERM: stop, signal.SIGINT: stop}
    handlers[signal.SIGHUP] = signal.SIG_IGN
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
