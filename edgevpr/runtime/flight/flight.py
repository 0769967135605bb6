"""A flight from start to end. Each pass of the loop reads the newest frame, recognises it, and passes the event, the
`Recognition` of this frame, to the autopilot and to observers: functions that count, monitor and log."""

import logging
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from edgevpr.core.config import Config, MavlinkConfig, SourceConfig
from edgevpr.core.errors import ImageError
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import FixReport, Frame, Position
from edgevpr.frames.level import Mount
from edgevpr.frames.source import read_intervals
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.conversation import LinkSettings
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight import systemd
from edgevpr.runtime.flight.autopilot import DRY_RUN, AutopilotOutput
from edgevpr.runtime.flight.camerawatch import MirrorWatch, TurnWatch
from edgevpr.runtime.flight.clock import Pace
from edgevpr.runtime.flight.flightio import FlightIO, FlightParts, open_real_io
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.frozenwatch import FrozenWatch, read_optics
from edgevpr.runtime.flight.governor import GovernorActuator
from edgevpr.runtime.flight.gpswatch import GpsWatch
from edgevpr.runtime.flight.heightwatch import HeightWatch
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.flight.notifier import Commands, Notifier
from edgevpr.runtime.flight.startup import apply_recorded_rate, find_origin, log_start, open_map
from edgevpr.runtime.flight.stop import StopNow
from edgevpr.runtime.flight.vitals import Vitals
from edgevpr.runtime.flight.watching import MapCoverageWatch, MapWatch, SurveyReporter, Tally
from edgevpr.runtime.preflight.pick import list_safe_candidates
from edgevpr.runtime.recognise.levelling import read_camera_lens
from edgevpr.runtime.recognise.recognition import Recognition, to_fields

_MAX_WAIT_S = 0.2  # longest wait of one pass of the loop for a frame

_log = logging.getLogger(__name__)


def fly(config: Config, positions: Path | None = None) -> int:
    """Fly, and return the exit code: 1 if any frame failed, else 0. `positions` is a file with the positions of the
    frames of a recording (None: there is none). Raises EdgevprError if the flight cannot start."""
    source = config.source
    steps_s = read_intervals(source.uri, positions)
    config = replace(config, source=apply_recorded_rate(source, steps_s))
    with open_real_io(config, positions, steps_s) as io:
        try:
            with closing(Flight.open(config, io)) as flight:
                return flight.run()
        except StopNow:
            _log.info("stopped before the flight began")
            return 0


class Flight:
    """A flight with all its parts open. Create it with `open`; close it after `run`."""

    def __init__(
        self, parts: FlightParts, camera: SourceConfig, *, min_accuracy_m: float, fewer_candidates: tuple[int, ...]
    ) -> None:
        self._parts, self._opened = parts, ExitStack()
        notifier, self._map_watch, self._tally = parts.notifier, MapWatch(parts.notifier), Tally()
        self._pace = Pace(parts.io.board.rate_hz, parts.io.clock)
        self._actuator = GovernorActuator(parts, self._pace, fewer_candidates)
        self._commands = Commands(parts.link, notifier)
        self._frozen = FrozenWatch(notifier, read_optics(camera, parts.recogniser), parts.autopilot)
        self._vitals = Vitals(
            parts, self._frozen, tally=self._tally, pace=self._pace, commands=self._commands, remarks=self._remarks
        )
        parts.recogniser.encoder.strip.report = lambda note: notifier.report("camera", Severity.WARNING, note)
        gps = GpsWatch(min_accuracy_m, notifier, parts.autopilot)
        self._surveyor = SurveyReporter(notifier, gps, camera, self._set_mount)
        self._observers: tuple[Callable[[Recognition], None], ...] = (
            self._tally.update,
            self._vitals.update,
            self._map_watch.update,
            MapCoverageWatch(notifier).update,
            TurnWatch(notifier, camera).update,
            MirrorWatch(notifier, parts.recogniser).update,
            HeightWatch(notifier, parts.autopilot).update,
            gps.update,
            self._surveyor.update,
            self._log_event,
        )

    @classmethod
    def open(cls, config: Config, io: FlightIO) -> "Flight":
        """Open map, log, link and source. Raises EdgevprError, and StopNow if a signal arrives meanwhile."""
        systemd.notify(EXTEND_TIMEOUT_USEC=systemd.MAX_START_US)
        with ExitStack() as stack:
            with io.stop.interrupt_start():
                recogniser = open_map(config, io)
                stack.callback(recogniser.place_map.close)
                log, clock, is_service = io.log, io.clock, systemd.is_service()
                flight_log = FlightLog(log.path, clock.mono_s, clock.utc_s, retries=is_service, max_mb=log.max_mb)
                stack.enter_context(flight_log)
            flight_log.write("start", **log_start(config, io, recogniser))
            step_s, settings, camera = 1 / io.board.rate_hz, config.mavlink, config.source
            looks_down = recogniser.technique.spec.looks_down
            shows_tilt = not looks_down or camera.gimbal or read_camera_lens(camera) is not None
            navigator = Navigator(
                settings.min_accuracy_m, step_s, not settings.send_fixes, is_level=camera.gimbal, shows_tilt=shows_tilt
            )
            origin = find_origin(recogniser.place_map, camera) if settings.set_origin else None
            link = open_link(settings, io, navigator, origin, stack)
            source = io.open_source(step_s, not looks_down)
            stack.callback(source.close)
            if link and not source.is_live and settings.send_fixes:
                _log.warning("%s is a recording: its fixes are not positions of this vehicle", camera.uri)
            notifier = Notifier(flight_log, link)
            autopilot = None
            if link:
                cores = io.board.cores
                autopilot = AutopilotOutput(link, navigator, notifier, settings=settings, cores=cores, clock=io.clock)
            if not settings.send_fixes:
                notifier.announce(Severity.WARNING, str(DRY_RUN))
            notifier.announce(Severity.INFO, f"started, {len(recogniser.place_map)} places", topic="start")
            parts = FlightParts(
                recogniser=recogniser,
                source=source,
                link=link,
                autopilot=autopilot,
                flight_log=flight_log,
                notifier=notifier,
                meter=FlightMeter(config.battery, io.board, io.clock, io.machine),
                io=io,
            )
            fewer = () if config.match.candidates else list_safe_candidates(recogniser.technique)
            flight = cls(parts, camera, min_accuracy_m=settings.min_accuracy_m, fewer_candidates=fewer)
            flight._opened = stack.pop_all()
        systemd.notify(READY=1)
        return flight

    def close(self) -> None:
        """Close everything that was opened, in reverse order."""
        self._opened.close()

    def run(self) -> int:
        """Fly until the source has ended or a signal ends the flight. Return 1 if any frame failed, else 0."""
        with suppress(StopNow):
            while not (self._parts.io.stop.is_requested or self._parts.source.ended):
                self._run_pass()
        self._end()
        return 1 if self._tally.unusable + self._tally.failed else 0

    def totals(self) -> dict[str, Any]:
        """Return the counts and costs of the flight so far: those of `FlightMeter.totals` and of the `Source`, the
        number of `queries`, and `left_out`, the number of unreadable places."""
        source = self._parts.source
        return {
            "queries": self._tally.queries,
            **self._parts.meter.totals(),
            "dropped": source.dropped,
            "refused": dict(source.refused),
            "latency_s": source.latency_s,
            "left_out": self._map_watch.left_out,
        }

    def _remarks(self) -> tuple[str | None, ...]:
        """Return short remarks for the status, in addition to the counts (None: nothing to report)."""
        paused, restriction = "paused" if self._commands.is_paused else None, self._actuator.governor.restriction
        age = self._parts.autopilot.age_summary if self._parts.autopilot else None
        return paused, age, restriction, self._map_watch.summary, self._parts.flight_log.fault

    def _run_pass(self) -> None:
        """Run one pass of the loop, with one frame at most."""
        source, clock, meter, pace = self._parts.source, self._parts.io.clock, self._parts.meter, self._pace
        self._vitals.beat()
        self._commands.obey()
        is_paused, is_query = self._commands.is_paused, (wait_s := pace.wait_s()) <= 0
        if (not is_query and not self._is_odometry_due()) or (is_paused and not source.is_live):  # a recording waits
            clock.sleep(_MAX_WAIT_S if is_query else min(wait_s, _MAX_WAIT_S))
            return
        with meter.measure_cost() as reading:
            try:
                frame: Frame | ImageError | None = source.read(_MAX_WAIT_S)
            except ImageError as error:
                frame = error
        if not source.is_live:  # reading a live source is mostly waiting
            meter.load.add_work(reading.cost)
        if frame is None:
            return
        if is_query:
            pace.record_frame(source.step_s)
        if is_paused:  # the newest picture is dropped, so that none is old when the flight resumes
            return
        with meter.measure_cost(thread_only=True) as work:
            with self._parts.io.stop.allow_interrupt():
                event = self._recognise(frame, is_query)
            event = replace(event, steps=replace(event.steps, read=reading.cost))
            if is_query:
                self._publish(event)
            elif self._parts.autopilot:
                meter.count(event)
                self._parts.autopilot.add_motion(event)
        meter.load.add_work(work.cost)
        self._actuator.update()  # here, so that each measurement covers a whole number of queries

    def _recognise(self, frame: Frame | ImageError, is_query: bool) -> Recognition:
        """Recognise a frame or, unless `is_query`, only measure its motion; refuse frozen pictures."""
        if isinstance(frame, ImageError):
            return self._parts.recogniser.report_unread(frame)
        parts, is_live = self._parts, self._parts.source.is_live
        if is_live and parts.autopilot:
            frame = parts.autopilot.correct_age(frame)
        vehicle = parts.link.predict_vehicle(frame.t_mono_s) if parts.link else None
        if is_live and (reason := self._frozen.judge(frame, vehicle)):
            return Recognition(frame=frame, vehicle=vehicle, reason=reason)
        event = (parts.recogniser.step if is_query else parts.recogniser.measure_motion)(frame, vehicle)
        return parts.autopilot.check_age(event) if is_live and parts.autopilot and event.accepted else event

    def _is_odometry_due(self) -> bool:
        """Return True if a frame for visual odometry alone is due: live, without GPS, between infrequent queries."""
        parts, interval_s = self._parts, self._parts.recogniser.odometry_interval_s
        if parts.autopilot is None or not parts.source.is_live or interval_s is None or self._commands.is_paused:
            return False
        return self._pace.is_odometry_due(interval_s) and parts.autopilot.needs_motion_frames()

    def _publish(self, event: Recognition) -> None:
        """Pass an event to the autopilot and then, with the report of its fix, to all observers. An exception is only
        logged: it must not end the flight."""
        meter = self._parts.meter
        meter.count(event)
        with meter.measure_cost() as reporting:
            try:
                if self._parts.autopilot:
                    event = self._parts.autopilot.report_match(event, meter.totals()["used_mah"])
                elif event.accepted:
                    why = Reason(ReasonCode.NO_LINK)
                    event = replace(event, fix=FixReport(query=event.name, sent=False, why=why))
            except Exception:
                _log.exception("the match could not be sent to the autopilot")
            for update in self._observers:
                try:
                    update(event)
                except Exception:
                    _log.exception("%s failed", update.__qualname__)
        meter.add(reporting.cost)

    def _log_event(self, event: Recognition) -> None:
        if event.frame is None or not event.is_query:
            self._parts.flight_log.write("unusable", reason=event.reason)
            return
        self._parts.flight_log.write(
            "query",
            t_frame_s=event.frame.t_mono_s,
            **to_fields(event),
            fix=event.fix,
            reading=event.steps.read,
            vehicle=event.vehicle,
            board=self._parts.meter.thermal,
            hints=event.hints.fields() if event.hints else None,
            totals=self.totals(),
        )

    def _set_mount(self, mount: Mount) -> None:
        """Level later pictures with this mount, and use only their fixes for navigation."""
        self._parts.recogniser.change(mount=mount)
        if self._parts.autopilot:
            self._parts.autopilot.reset_navigation()

    def _end(self) -> None:
        parts, totals = self._parts, self.totals()
        systemd.notify(STOPPING=1)
        try:
            self._surveyor.end()
        except Exception:
            _log.exception("the end of the survey could not be reported")
        if parts.link and parts.autopilot:
            parts.link.close()  # sends queued messages first, so that the log's last line counts them
            parts.autopilot.log_answers()
        parts.flight_log.write(
            "end",
            accepted=self._tally.accepted,
            unusable=self._tally.unusable + self._tally.failed,
            **totals,
            mavlink=parts.link.stats() if parts.link else None,
        )
        fixes = f", {parts.autopilot.summary}" if parts.autopilot else ""
        counts = f"{self._tally.queries} queries, {self._tally.accepted} accepted{fixes}"
        _log.info("%s, %.3f mAh (%.3f mAh of it for recognition)", counts, totals["used_mah"], totals["marginal_mah"])


def open_link(
    settings: MavlinkConfig, io: FlightIO, navigator: Navigator, origin: Position | None, stack: ExitStack
) -> Link | None:
    """Open the link to the flight controller; `stack` closes it. None if no link is configured."""
    if settings.link is None:
        return None
    link_settings = LinkSettings(
        component_id=settings.component_id,
        system_id=settings.system_id,
        max_fix_age_s=settings.max_fix_age_s,
        listener=navigator,
        origin=origin,
        signing=io.signing,
    )
    link = stack.enter_context(Link(parse_link(settings.link), link_settings, io.turns, io.drive))
    link.request_position()
    return link
