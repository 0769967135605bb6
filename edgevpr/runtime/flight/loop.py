"""The loop of a flight: it takes the newest frame, recognises it, and tells the listeners."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Protocol

from edgevpr.core.errors import ImageError
from edgevpr.core.types import NO_TAPE, Frame, StageCost, Tape
from edgevpr.frames.source import Source
from edgevpr.runtime.flight.autopilot import Autopilot
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.commands import Commands
from edgevpr.runtime.flight.governing import Governing
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.pace import Pace
from edgevpr.runtime.flight.reloading import NoReloading, Reloading
from edgevpr.runtime.flight.vitals import Vitals
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition

_TURN_S = 0.2  # the loop turns at least this often, with or without frames

_log = logging.getLogger(__name__)


class Observer(Protocol):
    """Listens to the events of a flight."""

    def tell(self, event: Recognition) -> None:
        """Take note of an event."""
        ...


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


def loop(
    source: Source,
    recogniser: Recogniser,
    autopilot: Autopilot,
    observers: Sequence[Observer],
    *,
    commands: Commands,
    governing: Governing,
    reloading: Reloading | NoReloading,
    vitals: Vitals,
    meter: FlightMeter,
    pace: Pace,
    clock: Clock,
    stop: Stop,
) -> None:
    """Turn until the source has ended or `stop` is asked for."""
    try:
        while not (stop.asked or source.ended):
            vitals.beat()
            commands.obey()
            reloading.look()
            if (wait_s := pace.wait_s()) > 0:
                clock.sleep(min(wait_s, _TURN_S))
                continue
            if commands.is_paused:
                _pass_over(source, clock)
                pace.taken()
                continue
            frame = problem = None
            with meter.reading_frame(source.is_live) as reading:
                try:
                    frame = source.read(_TURN_S)
                except ImageError as error:
                    problem = error
            if frame is None and problem is None:
                continue
            pace.taken()
            with meter.working():
                with stop.breaks_off():
                    event = recogniser.unread(problem) if problem else _recognised(frame, recogniser, autopilot)
                _tell(_with_reading(event, reading.cost), autopilot, observers, meter)
            governing.look()  # here, so that each reading covers a whole number of queries
    except StopNow:
        pass


def _pass_over(source: Source, clock: Clock) -> None:
    """Let the newest picture of a camera or stream go by, so that none is old when the flight goes on; a recording
    waits."""
    if source.is_live:
        with suppress(ImageError):
            source.read(_TURN_S)
    else:
        clock.sleep(_TURN_S)


def _recognised(frame: Frame, recogniser: Recogniser, autopilot: Autopilot) -> Recognition:
    return recogniser.step(frame, autopilot.vehicle_at(frame.t_mono_s))


def _with_reading(event: Recognition, reading: StageCost) -> Recognition:
    return replace(event, steps=replace(event.steps, read=reading))


def _tell(event: Recognition, autopilot: Autopilot, observers: Sequence[Observer], meter: FlightMeter) -> None:
    """Tell the autopilot of an event, then all observers, who also learn what became of its fix. A listener that fails
    is logged: it must not end the flight."""
    meter.count(event)
    with meter.telling():
        try:
            event = autopilot.told(event, meter.used_mah)
        except Exception:
            _log.exception("the autopilot could not be told")
        for observer in observers:
            try:
                observer.tell(event)
            except Exception:
                _log.exception("%s could not be told", type(observer).__name__)
