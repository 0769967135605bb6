"""The loop of a flight: it takes the newest frame, recognises it, logs it, tells the flight controller, keeps to the
board's limits, and feeds the watchdog. It ends when the source does, or when it is told to stop."""

import logging
import time
from dataclasses import asdict, replace

from edgevpr.config import Config
from edgevpr.errors import ImageError, ModelError
from edgevpr.frames.live import LiveSource
from edgevpr.frames.source import Source
from edgevpr.mavlink import messages
from edgevpr.mavlink.link import Link
from edgevpr.power.load import machine_load
from edgevpr.power.meter import stage
from edgevpr.power.thermal import limit_c
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.governor import Change, Governor, Limits, Setting, lowered, steps
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.systemd import notify, watchdog_interval_s
from edgevpr.runtime.recognise.hints import AUTOPILOT_FRESH_S, Hints, Sighting, hints_of, reach, use_next
from edgevpr.runtime.recognise.learn import POSITION_FRESH_S, Learner
from edgevpr.runtime.recognise.pipeline import Pipeline, claimed_accuracy_m, in_form, without_index
from edgevpr.runtime.recognise.record import record
from edgevpr.types import Frame, PlaceMatch, Position, StageCost, Vehicle

_log = logging.getLogger(__name__)
_TURN_S = 0.2  # the loop turns at least this often, frames or none
_HEALTH_S = 1.0
_GOVERN_S = 1.0


class _Stop(BaseException):
    """Raised by a signal while a frame is being recognised, so that a long comparison does not delay the end."""


class Flight:
    """What the loop carries from turn to turn."""

    def __init__(
        self,
        pipeline: Pipeline,
        source: Source,
        flight_log: FlightLog,
        link: Link | None,
        config: Config,
        learner: Learner | None = None,
    ):
        self._pipeline, self._source, self._flight_log, self._link = pipeline, source, flight_log, link
        self._config, self._learner, self._t_fix_s = config, learner, None
        self._send_fixes = config.mavlink.send_fixes
        self._reach_m_s = config.match.reach_m_s
        self._last_fix: Sighting | None = None
        self._use_hints = True
        self._step_s = 1 / pipeline.rate_hz
        self._watchdog_s = watchdog_interval_s()
        self._stopping = self._recognising = False
        self._next_query_s = self._next_health_s = self._next_watchdog_s = time.monotonic()
        self._source_lost = False
        self.queries = self.accepted = self.unusable = self._queries_throttled = 0
        self._meter = FlightMeter(pipeline.board, pipeline.pack, pipeline.regulator_efficiency)
        self._index_mb = {getattr(pipeline.technique, "form", None): pipeline.index.nbytes / 1e6}
        self._governor = _governor(pipeline, self._index_mb)

    @property
    def totals(self) -> dict[str, float | int | None]:
        """Since the start: queries, and those of them whose figures are not the board's usual ones, since it slowed
        itself down; charge and CPU-seconds (see `FlightMeter.totals`); and how many frames of a camera or stream nobody
        looked at (None: of a recording, none are left out)."""
        dropped = self._source.dropped if isinstance(self._source, LiveSource) else None
        counted = {"queries": self.queries, "queries_throttled": self._queries_throttled}
        return {**counted, **self._meter.totals(), "dropped": dropped}

    def close(self) -> None:
        """Let go of the sensors."""
        self._meter.close()

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
            with stage() as reading:
                frame = self._source.read(_TURN_S)
        except ImageError as error:
            self._say_unusable(error)
            return
        if frame is None:
            return
        self._next_query_s = max(self._next_query_s + self._step_s, time.monotonic())
        with stage(cpu_clock=time.thread_time) as busy:
            self._recognise(frame, reading.cost)
        self._meter.busy(busy.cost)
        if self._source.total:  # of a live source, reading is mostly waiting for the next frame
            self._meter.busy(reading.cost)
        if self._meter.age_s >= _GOVERN_S:  # here, where each reading is of a whole number of queries
            self._govern()

    def _recognise(self, frame: Frame, reading: StageCost) -> None:
        hints = self._hints(frame)
        used = hints if self._use_hints else None
        learns_by = self._link.vehicle_position(POSITION_FRESH_S) if self._learner and self._link else None
        self._recognising = True
        try:
            event = self._pipeline.step(frame, used)
        except ModelError as error:  # a network that was whole at the start made nothing of this picture
            self._say_unusable(error)
            return
        finally:
            self._recognising = False
        if self._learner:
            event = self._learner.unless_new(event)
        self._use_hints = use_next(hints, used is not None, event.candidate, event.accepted)
        if event.position:
            self._last_fix = Sighting(event.position, event.t_mono_s)
        self._meter.count(reading, StageCost(event.cost.t_encode_s + event.cost.t_match_s, event.cost.cpu_s))
        with stage() as telling:
            self._report(event, used, reading)
            if self._learner:
                self._learn(self._learner, frame, event, learns_by)
        self._meter.count(telling.cost)

    def _say_unusable(self, error: ImageError | ModelError) -> None:
        self.unusable += 1
        _log.warning("%s", error)
        self._flight_log.write("unusable", problem=str(error))

    def _learn(self, learner: Learner, frame: Frame, event: PlaceMatch, vehicle: Vehicle | None) -> None:
        """Make a place of the frame, where it is worth one; what is recognised from now on may be that place."""
        well = learner.trouble is None
        place = learner.learn(frame, event.descriptor, vehicle, self._t_fix_s)
        if place:
            self._flight_log.write(
                "learnt", place=place.place_id, query=frame.name, position=asdict(place.position), quality=place.quality
            )
            index = learner.index
            self._pipeline = replace(self._pipeline, index=index, accuracy_m=claimed_accuracy_m(self._config, index))
        if well and learner.trouble:
            say_learning_stopped(learner.trouble, self._flight_log, self._link)

    def _hints(self, frame: Frame) -> Hints | None:
        """What narrows the search for a frame. The autopilot knows nothing of frames that are a recording."""
        pipeline, around, heading_deg = self._pipeline, None, frame.heading_deg
        if pipeline.sequence:  # a place that a wrong hint kept out of one query would count as seen and unlike
            return None
        live = self._link is not None and not self._source.total
        vehicle = self._link.vehicle_position(AUTOPILOT_FRESH_S) if live else None
        if self._reach_m_s:
            autopilot = None
            if vehicle and vehicle.has_gps:  # without, it drifts, and our own last fix says more
                autopilot = Sighting(Position(vehicle.lat_deg, vehicle.lon_deg), vehicle.t_heard_s)
            margin_m = max(pipeline.accuracy_m, pipeline.rule.neighbour_m)
            around = reach(frame.t_mono_s, autopilot, self._last_fix, self._reach_m_s, margin_m)
        if heading_deg is None and vehicle:
            heading_deg = vehicle.heading_deg
        return hints_of(pipeline.index, around, heading_deg if pipeline.looks_down else None)

    def _report(self, event: PlaceMatch, hints: Hints | None, reading: StageCost) -> None:
        self.queries += 1
        self.accepted += event.accepted
        self._queries_throttled += bool(self._meter.thermal.throttled)
        totals = self.totals
        self._flight_log.write(
            "query",
            t_frame_s=event.t_mono_s,
            **record(event),
            reading=reading,
            board=self._meter.heat_fields(),
            hints=hints.fields() if hints else None,
            totals=totals,
        )
        if self._link is None:
            return
        now_s, cost = time.monotonic(), event.cost
        if event.position and self._send_fixes:
            self._send_fix(event.position, event)
        if event.accepted:
            place = event.candidate.place
            self._link.send(*messages.place_match(now_s, place.place_id, event.candidate.match.score))
        share = cost.cpu_s / ((cost.t_encode_s + cost.t_match_s) * self._pipeline.board.cores)
        self._link.send(*messages.query_figures(now_s, share, totals["used_mah"]))

    def _send_fix(self, position: Position, event: PlaceMatch) -> None:
        try:
            fix = messages.Fix(position.lat_deg, position.lon_deg, event.accuracy_m, event.t_mono_s)
        except ValueError as error:  # another program wrote nonsense into the map
            _log.warning("place %d: %s; no fix is sent", event.candidate.place.place_id, error)
            return
        self._link.send_fix(fix)
        self._t_fix_s = time.monotonic()

    def _tell_health(self, now_s: float) -> None:
        """Once a second: how it goes, to systemd; the load, to the flight controller; a camera lost or back, to all."""
        self._next_health_s = now_s + _HEALTH_S
        self._meter.look_at_heat()
        state = self._source.state
        counts = f"{self.queries} queries, {self.accepted} accepted, {self._meter.used_mah:.2f} mAh"
        learnt = self._learner and self._learner.summary
        notify(STATUS="; ".join(filter(None, (state, counts, self._held, learnt, self._flight_log.state))))
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
                now_s,
                load.core_shares,
                load.ram_used_bytes,
                load.ram_total_bytes,
                self._meter.thermal.temperature_c,
            )
        )

    def _govern(self) -> None:
        """Keep to the board's limits: what is lowered, or is back, is logged and said once."""
        change = self._governor.look(time.monotonic(), self._meter.reading())
        if change is None:
            return
        self._say_governed(change)
        self._step_s = 1 / change.after.rate_hz
        self._pipeline = replace(self._pipeline, candidates=change.after.candidates)
        if change.after.form != change.before.form:
            self._pipeline = without_index(self._pipeline)
            self._recognising = True  # a signal does not wait for it
            self._pipeline = in_form(self._pipeline, self._config, change.after.form)
            self._recognising = False
            self._index_mb[change.after.form] = self._pipeline.index.nbytes / 1e6
            self._meter.reading()  # what loading took says nothing of flying

    def _say_governed(self, change: Change) -> None:
        said = self._held or "back to what was asked"
        severity = messages.Severity.INFO if change.back else messages.Severity.WARNING
        text = said
        if change.before == change.after:
            said, text = "over a limit of the board", "over a limit of its board, see its log"
        _log.log(logging.INFO if change.back else logging.WARNING, "%s: %s", said, change.why)
        fields = {"from": asdict(change.before), "to": asdict(change.after), "why": change.why}
        self._flight_log.write("governor", **fields)
        if self._link:
            self._link.send(messages.status_text(severity, f"edgevpr: {text}"))

    @property
    def _held(self) -> str | None:
        """What is lowered to keep to the board's limits."""
        what = lowered(self._governor.setting, self._governor.asked)
        return f"held to {what}" if what else None


def _governor(pipeline: Pipeline, index_mb: dict[str | None, float]) -> Governor:
    """What keeps a pipeline within its board's profile. Candidates of a scan alone are none, and a sequence needs
    queries as often as the map was made."""
    board, technique = pipeline.board, pipeline.technique
    hottest_c = limit_c() if board.thermal_limit_c is None else board.thermal_limit_c
    asked = Setting(pipeline.rate_hz, pipeline.candidates, getattr(technique, "form", None))
    compares = technique.spec.fine is not None and pipeline.sequence is None  # a sequence wants rivals compared
    settings = steps(asked, pipeline.sequence is not None, compares, pipeline.smaller_forms)
    return Governor(Limits(board.cpu_share, board.memory_max_mb, hottest_c), settings, index_mb)


def say_learning_stopped(problem: str, flight_log: FlightLog, link: Link | None) -> None:
    """Tell everybody that nothing more is learnt, and the log why."""
    _log.warning("nothing more is learnt: %s", problem)
    flight_log.write("learning stopped", problem=problem)
    if link:
        link.send(messages.status_text(messages.Severity.WARNING, "edgevpr: nothing more is learnt, see its log"))
