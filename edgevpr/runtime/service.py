"""The flight: one loop that takes the newest frame, recognises it, logs it, tells the flight controller, and feeds the
watchdog. It ends when the source does, or on SIGTERM or SIGINT."""

import logging
import os
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from edgevpr import __version__
from edgevpr.config import Config
from edgevpr.errors import ImageError, UsageError
from edgevpr.mavlink import messages
from edgevpr.mavlink.link import Link, parse_link
from edgevpr.power.load import machine_load
from edgevpr.runtime.flightlog import FlightLog, start_fields
from edgevpr.runtime.frames import Source, open_source
from edgevpr.runtime.pipeline import Pipeline, open_pipeline
from edgevpr.runtime.record import record
from edgevpr.runtime.systemd import notify, watchdog_interval_s
from edgevpr.types import PlaceMatch, Position

_log = logging.getLogger(__name__)
_TURN_S = 0.2  # the loop turns at least this often, frames or none
_HEALTH_S = 1.0


class _Stop(BaseException):
    """Raised by a signal while a frame is being recognised, so that a long comparison does not delay the end."""


class Flight:
    """What the loop carries from turn to turn."""

    def __init__(self, pipeline: Pipeline, source: Source, flight_log: FlightLog, link: Link | None, config: Config):
        self._pipeline, self._source, self._flight_log, self._link = pipeline, source, flight_log, link
        self._send_fixes = config.mavlink.send_fixes
        self._step_s = 1 / pipeline.rate_hz
        self._watchdog_s = watchdog_interval_s()
        self._stopping = self._recognising = False
        self._next_query_s = self._next_health_s = self._next_watchdog_s = time.monotonic()
        self._source_lost = False
        self.queries = self.accepted = self.unusable = 0
        self.used_mah = self.marginal_mah = 0.0

    def stop(self, *_: object) -> None:
        """Signal handler: end after this turn, or at once where a frame is being recognised."""
        self._stopping = True
        if self._recognising:
            raise _Stop

    def run(self) -> None:
        """Turn until stopped or the source has ended."""
        try:
            while not (self._stopping or self._source.ended):
                self._turn()
        except _Stop:
            self._recognising = False  # a second signal finds nothing more to break off

    def _turn(self) -> None:
        now_s = time.monotonic()
        if self._watchdog_s and now_s >= self._next_watchdog_s:
            notify(WATCHDOG=1)
            self._next_watchdog_s = now_s + self._watchdog_s
        if now_s >= self._next_health_s:
            self._tell_health(now_s)
        if now_s < self._next_query_s:
            time.sleep(min(self._next_query_s - now_s, _TURN_S))
            return
        try:
            frame = self._source.read(_TURN_S)
        except ImageError as error:
            self.unusable += 1
            _log.warning("%s", error)
            self._flight_log.write("unusable", problem=str(error))
            return
        if frame is None:
            return
        self._next_query_s = max(self._next_query_s + self._step_s, time.monotonic())
        self._recognising = True
        event = self._pipeline.step(frame)
        self._recognising = False
        self._report(event)

    def _report(self, event: PlaceMatch) -> None:
        self.queries += 1
        self.accepted += event.accepted
        self.used_mah += event.cost.used_mah
        self.marginal_mah += event.cost.marginal_mah
        totals = {"queries": self.queries, "used_mah": self.used_mah, "marginal_mah": self.marginal_mah}
        self._flight_log.write("query", t_frame_s=event.t_mono_s, **record(event), totals=totals)
        if self._link is None:
            return
        now_s, cost = time.monotonic(), event.cost
        if event.position and self._send_fixes:
            self._send_fix(event.position, event)
        if event.accepted:
            place = event.candidate.place
            self._link.send(*messages.place_match(now_s, place.place_id, event.candidate.match.score))
        share = cost.cpu_s / ((cost.t_encode_s + cost.t_match_s) * self._pipeline.board.cores)
        self._link.send(*messages.query_figures(now_s, share, self.used_mah))

    def _send_fix(self, position: Position, event: PlaceMatch) -> None:
        try:
            fix = messages.Fix(position.lat_deg, position.lon_deg, event.accuracy_m, event.t_mono_s)
        except ValueError as error:  # another program wrote nonsense into the map
            _log.warning("place %d: %s; no fix is sent", event.candidate.place.place_id, error)
            return
        self._link.send_fix(fix)

    def _tell_health(self, now_s: float) -> None:
        """Once a second: how it goes, to systemd; the load, to the flight controller; a camera lost or back, to all."""
        self._next_health_s = now_s + _HEALTH_S
        state = self._source.state
        counts = f"{self.queries} queries, {self.accepted} accepted, {self.used_mah:.2f} mAh"
        notify(STATUS="; ".join(filter(None, (state, counts, self._flight_log.state))))
        lost = state.startswith(("lost", "nothing there"))
        if lost != self._source_lost:
            self._source_lost = lost
            _log.warning("source: %s", state)
            self._flight_log.write("source", state=state)
            if self._link:
                severity = messages.Severity.WARNING if lost else messages.Severity.INFO
                self._link.send(messages.status_text(severity, f"edgevpr: camera {'lost' if lost else 'is back'}"))
        if self._link is None:
            return
        self._link.set_health(messages.Health.CRITICAL if lost else messages.Health.ACTIVE)
        load = machine_load()
        self._link.send(
            messages.computer_status(
                now_s, load.core_shares, load.ram_used_bytes, load.ram_total_bytes, load.temperature_c
            )
        )


def fly(config: Config, positions: Path | None = None) -> int:
    """Open everything, fly, close everything; returns the exit code. Raises a sentence where it cannot start."""
    if config.source.uri is None:
        raise UsageError("There is no source of frames: name one with --source, or `source: {uri: ...}`.")
    address = parse_link(config.mavlink.link) if config.mavlink.link else None
    with ExitStack() as stack:
        pipeline = open_pipeline(config)
        stack.callback(pipeline.place_map.close)
        _log.info("version %s on %s", __version__, pipeline.board.title)
        _log.info("%s", pipeline.reason)
        flight_log = stack.enter_context(FlightLog(config.log.path, wait="NOTIFY_SOCKET" in os.environ))
        board = pipeline.board
        if not board.verified:
            _log.warning("mAh are estimates: the power of %s is unverified (%s)", board.title, board.source)
        decided = {
            "reason": pipeline.reason,
            "rule": pipeline.rule,
            "candidates": pipeline.candidates,
            "accuracy_m": pipeline.accuracy_m,
            "rate_hz": pipeline.rate_hz,
            "idle_w": board.idle_w,
            "full_w": board.full_w,
            "power_verified": board.verified,
        }
        flight_log.write("start", **start_fields(config, board.name, pipeline.technique.spec), decided=decided)
        link = stack.enter_context(Link(address, config.mavlink.component_id)) if address else None
        source = open_source(config.source.uri, step_s=1 / pipeline.rate_hz, positions=positions, live=True)
        stack.callback(source.close)
        if link and config.mavlink.send_fixes and source.total:
            _log.warning(
                "%s is a recording: the fixes sent say where it was made, not where you are", config.source.uri
            )
        flight = Flight(pipeline, source, flight_log, link, config)
        with _signals(flight):
            notify(READY=1)
            flight.run()
            notify(STOPPING=1)
        if link:
            link.close()  # what waits is sent first, so that the log's last line counts it
        flight_log.write(
            "end",
            queries=flight.queries,
            accepted=flight.accepted,
            unusable=flight.unusable,
            used_mah=flight.used_mah,
            marginal_mah=flight.marginal_mah,
            mavlink=link.stats() if link else None,
        )
        _log.info(
            "%d queries, %d accepted, %.3f mAh (%.3f of them for recognising)",
            flight.queries,
            flight.accepted,
            flight.used_mah,
            flight.marginal_mah,
        )
    return 1 if flight.unusable else 0


@contextmanager
def _signals(flight: Flight) -> Iterator[None]:
    """SIGTERM and SIGINT end the flight while this lasts."""
    before = {number: signal.signal(number, flight.stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
