"""A flight: wires the listeners to the loop, with everything that has been opened for it, and runs the loop."""

from dataclasses import dataclass
from typing import Any

from edgevpr.core.config import Config
from edgevpr.core.types import NO_TAPE
from edgevpr.frames.source import Source
from edgevpr.runtime.flight.autopilot import Autopilot
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.commands import Commands
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.flightstate import FlightState
from edgevpr.runtime.flight.governing import Governing
from edgevpr.runtime.flight.gpswatch import GpsWatch
from edgevpr.runtime.flight.learning import Learning
from edgevpr.runtime.flight.loop import Observer, Stop, loop
from edgevpr.runtime.flight.mapstate import MapState
from edgevpr.runtime.flight.metering import FlightMeter, meter_of_flight
from edgevpr.runtime.flight.pace import Pace
from edgevpr.runtime.flight.querylog import QueryLog, totals_of
from edgevpr.runtime.flight.reloading import NoReloading, Reloading, Reread
from edgevpr.runtime.flight.sight import Sight
from edgevpr.runtime.flight.statussocket import NoReaders, Readers
from edgevpr.runtime.flight.tally import Tally
from edgevpr.runtime.flight.vitals import Vitals
from edgevpr.runtime.recognise.learn import Learner
from edgevpr.runtime.recognise.recogniser import Recogniser

_NOBODY = NoReaders()


@dataclass(frozen=True, slots=True)
class Flown:
    """Result of a flight: counts of its events, and `totals` of what it took (see `querylog.totals_of`)."""

    queries: int
    accepted: int
    failed: int
    totals: dict[str, Any]


def rate_hz(config: Config, recogniser: Recogniser) -> float:
    """Return the queries a second: the configuration's figure, else that of the board's profile."""
    return config.source.rate_hz or recogniser.meter.board.rate_hz


def fly(
    recogniser: Recogniser,
    source: Source,
    config: Config,
    *,
    flight_log: FlightLog,
    autopilot: Autopilot,
    stop: Stop,
    learner: Learner | None = None,
    reread: Reread | None = None,
    fewer_candidates: tuple[int, ...] = (),
    smaller_forms: tuple[str, ...] = (),
    clock: Clock | None = None,
    meter: FlightMeter | None = None,
    readers: Readers = _NOBODY,
) -> Flown:
    """Fly until the source has ended or `stop` is asked for.

    `learner` makes places (None: nothing is learnt); `reread` asks for the configuration to be read again;
    `fewer_candidates`, and `smaller_forms` of the index, are those that the governor may change to. `clock` and `meter`
    are the real ones unless given. `readers` are told the status.
    """
    clock = clock or Clock()
    if meter is None:
        meter = meter_of_flight(config, recogniser.meter.board, clock, NO_TAPE)
    map_state = MapState(flight_log, autopilot)
    tally, pace = Tally(), Pace(rate_hz(config, recogniser), clock)
    governing = Governing(
        recogniser,
        pace,
        config,
        meter=meter,
        flight_log=flight_log,
        autopilot=autopilot,
        clock=clock,
        fewer_candidates=fewer_candidates,
        smaller_forms=smaller_forms,
    )
    reloading: Reloading | NoReloading = NoReloading()
    if reread:
        reloading = Reloading(reread, config, flight_log, lambda new: governing.take(new, rate_hz(new, recogniser)))
    commands = Commands(autopilot, flight_log, learner)
    state = FlightState(
        source=source,
        autopilot=autopilot,
        meter=meter,
        tally=tally,
        pace=pace,
        commands=commands,
        clock=clock,
        remarks=(
            lambda: commands.summary,
            lambda: governing.held,
            lambda: learner and learner.summary,
            lambda: map_state.summary,
            lambda: flight_log.state,
        ),
    )
    vitals = Vitals(
        source=source,
        flight_log=flight_log,
        autopilot=autopilot,
        meter=meter,
        tally=tally,
        commands=commands,
        clock=clock,
        state=state,
        readers=readers,
    )

    def totals() -> dict[str, Any]:
        return totals_of(tally, meter, source, map_state)

    observers: list[Observer] = [
        tally,
        state,
        map_state,
        Sight(flight_log, autopilot),
        GpsWatch(config.mavlink.min_accuracy_m, flight_log, autopilot),
        QueryLog(flight_log, meter, totals),
    ]
    if learner:
        observers.append(Learning(learner, flight_log, autopilot))
    try:
        loop(
            source,
            recogniser,
            autopilot,
            observers,
            commands=commands,
            governing=governing,
            reloading=reloading,
            vitals=vitals,
            meter=meter,
            pace=pace,
            clock=clock,
            stop=stop,
        )
    finally:
        meter.close()
    return Flown(tally.queries, tally.accepted, tally.unusable + tally.failed, totals())
