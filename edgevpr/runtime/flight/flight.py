"""A flight from start to end: `Flight.open` opens everything, `run` flies, and `close` closes everything.

Each pass of the loop takes the newest frame, recognises it, and reports the event, the `Recognition` of this frame, to
the autopilot and to observers (functions that count, watch, log and learn). The same code flies in the air and in a
replay: only its `World`, all that is outside of it, differs.
"""

import logging
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from edgevpr.core.config import Config, MavlinkConfig
from edgevpr.core.errors import ImageError
from edgevpr.core.types import Frame, Position
from edgevpr.frames.level import Mount
from edgevpr.frames.source import recorded_steps
from edgevpr.mavlink.address import parse_links
from edgevpr.mavlink.conversation import LinkSettings
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight import systemd
from edgevpr.runtime.flight.aboard import at_recorded_rate, find_origin, look_ahead, open_map, rate_hz, say_start
from edgevpr.runtime.flight.autopilot import DRY_RUN, ToAutopilot, unsent
from edgevpr.runtime.flight.camerawatch import MirrorWatch, ScaleWatch, TurnWatch
from edgevpr.runtime.flight.clock import Pace
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.frozenwatch import FrozenWatch, read_optics
from edgevpr.runtime.flight.governor import Governing
from edgevpr.runtime.flight.heightwatch import HeightWatch
from edgevpr.runtime.flight.herald import Commands, Herald
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.flight.tiles import tiles_of
from edgevpr.runtime.flight.vitals import Vitals
from edgevpr.runtime.flight.watching import GpsWatch, MapWatch, Sight, Surveyor, Tally
from edgevpr.runtime.flight.world import Crew, StopNow, World, in_the_air
from edgevpr.runtime.preflight.pick import trusted_candidates
from edgevpr.runtime.recognise.recognition import Recognition, fields_of

_TURN_S = 0.2  # a pass of the loop waits no longer than this for a frame

_log = logging.getLogger(__name__)


def fly(config: Config, positions: Path | None = None) -> int:
    """Fly in the air, and return the exit code: 1 if any frame failed, else 0. `positions` is a file with the positions
    of the frames, if the source is a recording (None: there is none). Raises an EdgevprError, one sentence, if the
    flight cannot start."""
    steps_s = recorded_steps(config.source.uri, positions)
    config = at_recorded_rate(config, steps_s)
    with in_the_air(config, positions, steps_s) as world:
        try:
            with closing(Flight.open(config, world)) as flight:
                return flight.run()
        except StopNow:
            _log.info("stopped before the flight began")
            return 0


class Flight:
    """A flight whose map, log, links and source of frames are open. `open` makes it; close it after `run`."""

    def __init__(self, config: Config, crew: Crew) -> None:
        self._config, self._crew, self._opened = config, crew, ExitStack()
        herald, self._map_watch, self._tally = crew.herald, MapWatch(crew.herald), Tally()
        self._pace = Pace(rate_hz(config, crew.recogniser), crew.clock)
        self._governing = Governing(crew, self._pace)
        self._commands = Commands(crew.link, herald, crew.learner)
        self._frozen = FrozenWatch(herald, read_optics(config.source, crew.recogniser), crew.autopilot)
        self._vitals = Vitals(
            crew, self._frozen, tally=self._tally, pace=self._pace, commands=self._commands, remarks=self._remarks
        )
        gps = GpsWatch(config.mavlink.min_accuracy_m, herald, crew.autopilot)
        self._surveyor = Surveyor(herald, gps, config.source, self._look)
        self._observers: tuple[Callable[[Recognition], None], ...] = (
            self._tally.tell,
            self._vitals.tell,
            self._map_watch.tell,
            Sight(herald).tell,
            ScaleWatch(herald).tell,
            TurnWatch(herald, config.source).tell,
            MirrorWatch(herald, crew.recogniser, config).tell,
            HeightWatch(herald, crew.autopilot).tell,
            gps.tell,
            self._surveyor.tell,
            self._log_event,
            self._learn,
            *([crew.tiles.tell] if crew.tiles else []),
        )

    @classmethod
    def open(cls, config: Config, world: World) -> "Flight":
        """Open the map, the log, the links and the source, in this order. Raises an EdgevprError if one of them cannot
        be opened, and StopNow if a signal ends the flight before it has begun."""
        systemd.notify(EXTEND_TIMEOUT_USEC=systemd.LONGEST_START_US)
        with ExitStack() as stack:
            with world.stop.beginning():
                recogniser, learner, cannot_learn = open_map(config, world)
                stack.callback(recogniser.place_map.close)
                flight_log = _open_log(world)
                stack.enter_context(flight_log)
                found = look_ahead(recogniser, config, world)
            flight_log.write("start", **say_start(config, world, recogniser, found))
            step_s = 1 / rate_hz(config, recogniser)
            is_muted, is_level = not config.mavlink.send_fixes, config.source.gimbal
            navigator = Navigator(config.mavlink.min_accuracy_m, step_s, is_muted, is_level)
            origin = find_origin(recogniser.place_map, config.source) if config.mavlink.set_origin else None
            link, ground = open_links(config.mavlink, world, navigator, origin, stack)
            source, source_uri = world.open_source(step_s), config.source.uri
            stack.callback(source.close)
            if link and not source.is_live and (learner or config.mavlink.send_fixes):
                _log.warning("%s is a recording: its fixes, and what it learns, do not say where you are", source_uri)
            herald = Herald(flight_log, link)
            if tiles := tiles_of(recogniser, config.match, herald, world.tape):
                stack.callback(tiles.close)
            autopilot = None
            if link:
                settings, cores = config.mavlink, world.board.cores
                autopilot = ToAutopilot(link, navigator, herald, settings=settings, cores=cores, clock=world.clock)
            if not config.mavlink.send_fixes:
                herald.say(Severity.WARNING, DRY_RUN)
            if cannot_learn:
                _say_learning_stopped(herald, cannot_learn)
            herald.say(Severity.INFO, f"started, {len(recogniser.place_map)} places", topic="start")
            meter = FlightMeter(config.battery, world.board, world.clock, tape=world.tape)
            crew = Crew(
                recogniser=recogniser,
                learner=learner,
                tiles=tiles,
                source=source,
                link=link,
                ground=ground,
                autopilot=autopilot,
                flight_log=flight_log,
                herald=herald,
                meter=meter,
                clock=world.clock,
                stop=world.stop,
                status=world.status,
                fewer_candidates=() if config.match.candidates else trusted_candidates(recogniser.technique),
            )
            flight = cls(config, crew)
            flight._opened = stack.pop_all()
        systemd.notify(READY=1)
        return flight

    def close(self) -> None:
        """Close everything that was opened, in reverse order."""
        self._opened.close()

    def run(self) -> int:
        """Fly until the source has ended or a signal ends the flight. Return 1 if any frame failed, else 0."""
        with suppress(StopNow):
            while not (self._crew.stop.asked or self._crew.source.ended):
                self._turn()
        self._end()
        return 1 if self._tally.unusable + self._tally.failed else 0

    def totals(self) -> dict[str, Any]:
        """Return the counts and costs of the flight so far: those of `FlightMeter.totals`; `queries`; those of the
        `Source` (`dropped`, `refused`, `latency_s`); `left_out`, the number of places that cannot be read."""
        source = self._crew.source
        return {
            "queries": self._tally.queries,
            **self._crew.meter.totals(),
            "dropped": source.dropped,
            "refused": dict(source.refused),
            "latency_s": source.latency_s,
            "left_out": self._map_watch.left_out,
        }

    def _remarks(self) -> tuple[str | None, ...]:
        """Return what people should know beside the counts, each a few words (None: nothing)."""
        learnt = self._crew.learner.summary if self._crew.learner else None
        held, left_out = self._governing.governor.held, self._map_watch.summary
        return self._commands.summary, held, learnt, left_out, self._crew.flight_log.state

    def _turn(self) -> None:
        """Run one pass of the loop, with one frame at most."""
        source, clock, meter, pace = self._crew.source, self._crew.clock, self._crew.meter, self._pace
        self._vitals.beat()
        self._commands.obey()
        is_paused, is_query = self._commands.is_paused, (wait_s := pace.wait_s()) <= 0
        if (not is_query and not self._is_time_for_stride()) or (is_paused and not source.is_live):  # a recording waits
            clock.sleep(_TURN_S if is_query else min(wait_s, _TURN_S))
            return
        with meter.timed() as reading:
            try:
                frame: Frame | ImageError | None = source.read(_TURN_S)
            except ImageError as error:
                frame = error
        if not source.is_live:  # of a live source, reading is mostly waiting
            meter.load.busy(reading.cost)
        if frame is None:
            return
        if is_query:
            pace.taken(source.step_s)
        if is_paused:  # the newest picture is dropped, so that none is old when the flight goes on
            return
        with meter.timed(thread_only=True) as work:
            with self._crew.stop.breaks_off():
                event = self._recognise(frame, is_query)
            event = replace(event, steps=replace(event.steps, read=reading.cost))
            if is_query:
                self._tell(event)
            elif self._crew.autopilot:
                meter.count(event)
                self._crew.autopilot.saw(event)
        meter.load.busy(work.cost)
        self._governing.look()  # here, so that each reading covers a whole number of queries

    def _recognise(self, frame: Frame | ImageError, is_query: bool) -> Recognition:
        """Recognise a frame or, unless it `is_query`, measure its stride; refuse one of pictures that are frozen."""
        if isinstance(frame, ImageError):
            return self._crew.recogniser.report_unread(frame)
        vehicle = self._crew.link.vehicle_at(frame.t_mono_s) if self._crew.link else None
        if self._crew.source.is_live and (reason := self._frozen.judge(frame, vehicle)):
            return Recognition(frame=frame, vehicle=vehicle, reason=reason)
        return (self._crew.recogniser.step if is_query else self._crew.recogniser.measure_motion)(frame, vehicle)

    def _is_time_for_stride(self) -> bool:
        """Tell whether to take a picture that is no query, for the motion that it shows: between rare queries, while
        the autopilot has no GPS. The pictures of a recording are all queries."""
        crew = self._crew
        if crew.autopilot is None or not crew.source.is_live or not crew.recogniser.measures_strides:
            return False
        return not self._commands.is_paused and self._pace.is_time_for_stride() and crew.autopilot.wants_strides()

    def _tell(self, event: Recognition) -> None:
        """Report an event to the autopilot, then to all observers, which also get the report of its fix. An exception
        in one of these is logged: it must not end the flight."""
        meter = self._crew.meter
        meter.count(event)
        with meter.timed() as telling:
            try:
                if self._crew.autopilot:
                    event = self._crew.autopilot.told(event, meter.totals()["used_mah"])
                elif event.accepted:
                    event = replace(event, fix=unsent(event, "there is no link"))
            except Exception:
                _log.exception("the autopilot could not be told")
            for tell in self._observers:
                try:
                    tell(event)
                except Exception:
                    _log.exception("%s could not be told", tell.__qualname__)
        meter.energy.add(telling.cost)

    def _log_event(self, event: Recognition) -> None:
        """Write the log line of an event: of kind "query", or "unusable" for a frame that could not become a query."""
        if event.frame is None or not event.is_query:
            self._crew.flight_log.write("unusable", problem=event.reason)
            return
        self._crew.flight_log.write(
            "query",
            t_frame_s=event.frame.t_mono_s,
            **fields_of(event),
            fix=event.fix,
            last_fix=event.last_fix,
            reading=event.steps.read,
            vehicle=event.vehicle,
            board=self._crew.meter.thermal,
            hints=event.hints.fields() if event.hints else None,
            totals=self.totals(),
        )

    def _look(self, mount: Mount) -> None:
        """Level the pictures to come as those of a camera that looks there, and navigate by their fixes only."""
        self._crew.recogniser.change(mount=mount)
        if self._crew.autopilot:
            self._crew.autopilot.begin_anew()

    def _learn(self, event: Recognition) -> None:
        """Add the frame of an event to the map as a new place, if `Learner` finds it worth remembering."""
        learner = self._crew.learner
        if learner is None:
            return
        well = learner.trouble is None
        place = learner.learn(event)
        if place:
            self._crew.flight_log.write(
                "learnt",
                place=place.place_id,
                query=event.name,
                position=place.position and asdict(place.position),
                quality=place.quality,
            )
        if well and learner.trouble:
            _say_learning_stopped(self._crew.herald, learner.trouble)

    def _end(self) -> None:
        crew, totals = self._crew, self.totals()
        systemd.notify(STOPPING=1)
        try:
            self._surveyor.end()
        except Exception:
            _log.exception("the end of the survey could not be told")
        if crew.link and crew.autopilot:
            crew.link.close()  # sends waiting messages first, so that the log's last line counts them
            crew.autopilot.log_answers()
        crew.flight_log.write(
            "end",
            accepted=self._tally.accepted,
            unusable=self._tally.unusable + self._tally.failed,
            **totals,
            mavlink=crew.link.stats() if crew.link else None,
            **({"ground": crew.ground.stats()} if crew.ground else {}),
            **({"learnt": crew.learner.totals} if crew.learner else {}),
        )
        fixes = f", {crew.autopilot.summary}" if crew.autopilot else ""
        counts = f"{self._tally.queries} queries, {self._tally.accepted} accepted{fixes}"
        _log.info("%s, %.3f mAh (%.3f of them for recognising)", counts, totals["used_mah"], totals["marginal_mah"])
        if crew.learner:
            _log.info("%s, %d in %s", crew.learner.summary, len(crew.recogniser.place_map), self._config.map)


def _open_log(world: World) -> FlightLog:
    log, clock, is_service = world.log, world.clock, systemd.is_there()
    return FlightLog(log.path, clock.mono_s, clock.utc_s, wait=is_service, max_mb=log.max_mb, tape=world.tape)


def open_links(
    settings: MavlinkConfig, world: World, navigator: Navigator, origin: Position | None, stack: ExitStack
) -> tuple[Link | None, Link | None]:
    """Open the links to flight controller and ground station (None: not configured), which `stack` closes. `origin`: as
    in `LinkSettings`."""
    address, ground_address = parse_links(settings.link, settings.ground)
    if address is None:
        return None, None
    link_settings = LinkSettings(
        component_id=settings.component_id,
        system_id=settings.system_id,
        max_fix_age_s=settings.max_fix_age_s,
        listener=navigator,
        tap=world.tap,
        origin=origin,
        signing=world.signing,
        tape=world.tape,
    )
    link = stack.enter_context(world.link(address, link_settings))
    link.want_position()
    return link, stack.enter_context(world.ground(ground_address, link)) if ground_address else None


def _say_learning_stopped(herald: Herald, problem: str) -> None:
    text, ground = f"nothing more is learnt: {problem}", "nothing more is learnt, see its log"
    herald.tell("learning stopped", Severity.WARNING, text, ground=ground, topic="learning", problem=problem)
