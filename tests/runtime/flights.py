"""Flights in this process, by a clock to turn: the real recogniser, loop and log, and who listens."""

from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

from fakes import FakeClock, FakeLink, FakeSource, make_vehicle
from pictures import draw_texture

from edgevpr.core.arrays import Image
from edgevpr.core.config import load_config
from edgevpr.power.boards import load_board, resolve_board
from edgevpr.power.meter import QueryMeter
from edgevpr.power.thermal import ThermalWatch
from edgevpr.runtime.flight.autopilot import AutopilotOutput
from edgevpr.runtime.flight.flight import Flight as FlightItself
from edgevpr.runtime.flight.flightio import FlightParts
from edgevpr.runtime.flight.flightlog import FlightLog, read_log
from edgevpr.runtime.flight.machine import Machine
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.flight.notifier import Notifier
from edgevpr.runtime.flight.stop import Stop
from edgevpr.runtime.recognise.opening import open_recogniser

PLACES = 30
STEP_DEG = 0.001  # of latitude: 111 m


def connect_autopilot(clock: FakeClock, off_deg=0.0042, has_gps=False) -> FakeLink:
    """A link to the autopilot of an aircraft that passes a place a second, the first at 1000 s. The position that it
    reports is `off_deg` of longitude off: 300 m unless given, so that a single match agrees with it and improves it."""

    def report_vehicle():
        known = {"has_gps": has_gps, "position_sd_m": 100.0, "velocity_m_s": (0.0, STEP_DEG * 111_195)}
        return make_vehicle(50 + STEP_DEG * (clock() - 1000.0), 8.0 + off_deg, clock(), **known)

    return FakeLink(clock, vehicle=report_vehicle)


class Flight:
    """A flight with a map, ready to be flown: `fly` does so and gives the lines of its log but the last, the `end`.

    `settings` are keys of the configuration."""

    def __init__(self, place_map: Path, log: Path, clock: FakeClock, link: FakeLink | None = None, **settings) -> None:
        self.config = load_config(None, {"map": str(place_map), "source.uri": "/dev/video0"} | settings)
        self.board = resolve_board(load_board(self.config.board), self.config.source, self.config.memory)
        self.log, self.clock, self.link = log, clock, link
        self.recogniser = open_recogniser(self.config, self.board, uses_hints=True)
        board, cpu_clock = self.recogniser.meter.board, clock.clock.process_cpu_s
        self.recogniser.meter = QueryMeter(board, self.config.battery, wall_clock=clock, cpu_clock=cpu_clock)
        self.stop = Stop()
        self.end: dict = {}

    def fly(
        self,
        source: FakeSource,
        meter: FlightMeter | None = None,
        fewer_candidates: tuple[int, ...] = (),
        status=None,
        start: dict | None = None,
    ) -> list[dict]:
        settings, clock = self.config.mavlink, self.clock.clock
        with ExitStack() as opened:
            opened.callback(self.recogniser.place_map.close)
            flight_log = opened.enter_context(FlightLog(self.log, clock=self.clock))
            if start:
                flight_log.write("start", **start)
            notifier, autopilot = Notifier(flight_log, self.link), None
            if self.link:
                navigator = self.link.listener = Navigator(settings.min_accuracy_m, 1.0)
                cores = self.board.cores
                autopilot = AutopilotOutput(self.link, navigator, notifier, settings=settings, cores=cores, clock=clock)
            machine = Machine(measure_heat=ThermalWatch(hot_c=self.board.thermal_limit_c).read)
            parts = FlightParts(
                recogniser=self.recogniser,
                source=source,
                link=self.link,
                autopilot=autopilot,
                flight_log=flight_log,
                notifier=notifier,
                meter=meter or FlightMeter(self.config.battery, self.board, clock, machine),
                io=SimpleNamespace(board=self.board, clock=clock, machine=machine, stop=self.stop, status=status),
            )
            accuracy_m = settings.min_accuracy_m
            FlightItself(parts, self.config.source, min_accuracy_m=accuracy_m, fewer_candidates=fewer_candidates).run()
        *lines, self.end = read_log(self.log)
        return lines


def prepare_flight(
    folder: Path, tmp_path: Path, link: FakeLink | None, clock: FakeClock, technique="cohog", **settings
):
    """A flight of a query a second with the map of a technique."""
    settings = {"source.rate_hz": 1.0} | settings
    return Flight(folder / f"{technique}.gpkg", tmp_path / "log", clock, link, **settings)


def draw_pictures(count: int, first: int = 0) -> list[Image]:
    return [draw_texture(first + number, 240, 320) for number in range(count)]


def make_flight_meter(flight: Flight, kind=FlightMeter, watch: ThermalWatch | None = None, **more) -> FlightMeter:
    """A meter of the flight as a whole, for a test that looks into it."""
    machine = Machine(measure_heat=(watch or ThermalWatch()).read)
    return kind(flight.config.battery, flight.board, flight.clock.clock, machine, **more)


def select(lines: list[dict], kind: str) -> list[dict]:
    return [line for line in lines if line["kind"] == kind]


def noop() -> None:
    """Do nothing to a map."""


def fly_acts(place_map: Path, log: Path, acts) -> tuple[list[dict], list[dict], Flight]:
    """Fly over the first places of a map, an act before each frame. Returns the queries, all lines, and the flight."""
    clock, calls = FakeClock(), iter(acts)
    flight = Flight(place_map, log, clock, connect_autopilot(clock), **{"source.rate_hz": 1.0})
    seen = [draw_texture(number % PLACES, 240, 320) for number in range(len(acts))]
    lines = flight.fly(FakeSource(seen, clock, work=lambda: next(calls)()))
    return select(lines, "query"), lines, flight
