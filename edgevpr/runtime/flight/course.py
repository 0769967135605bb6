"""The course of a flight, from its opened map to the last line of its log: the same in the air and in a replay."""

import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import astuple, dataclass
from typing import Any

from edgevpr import __version__
from edgevpr.core.config import Config, MavlinkConfig
from edgevpr.core.types import FIX_MAX_AGE_S, NO_TAPE, Position, Tape
from edgevpr.frames.source import Source
from edgevpr.mavlink.address import LinkAddress, parse_links
from edgevpr.mavlink.ground import GroundLink
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.signing import NotSigning, Signing
from edgevpr.mavlink.wire import Tap, untapped
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import Board
from edgevpr.runtime.flight.autopilot import DRY_RUN, Mood, NoAutopilot, ToAutopilot
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.flight import fly, rate_hz
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.learning import say_learning_stopped
from edgevpr.runtime.flight.loop import Stop
from edgevpr.runtime.flight.metering import meter_of_flight, meter_of_queries
from edgevpr.runtime.flight.navigator import Muted, Navigator
from edgevpr.runtime.flight.reloading import Reread
from edgevpr.runtime.flight.sourcesets import SourceSets
from edgevpr.runtime.flight.startline import start_fields
from edgevpr.runtime.flight.statussocket import Readers
from edgevpr.runtime.flight.systemd import more_time_to_start, notify
from edgevpr.runtime.preflight.choose import too_late
from edgevpr.runtime.preflight.pick import Outlook, outlook, trusted_candidates, trusted_forms
from edgevpr.runtime.recognise.learn import Learner
from edgevpr.runtime.recognise.opening import open_learning, open_recogniser
from edgevpr.runtime.recognise.recogniser import Recogniser

_RELOAD_S = 10.0  # a map that takes longer to load is not loaded again in flight: nothing is recognised meanwhile

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """The world of a flight. `tape` and `clock` give what comes in and when, `open_source` (with the seconds between
    two frames) the pictures; `link` and `ground` are the kinds of the two links, with their `signing` and `tap`.
    `recording` is where the flight is recorded (None: it is not)."""

    tape: Tape
    clock: Clock
    flight_log: FlightLog
    readers: Readers
    open_source: Callable[[float], Source]
    link: type[Link]
    ground: type[GroundLink]
    signing: Signing | NotSigning
    tap: Tap
    recording: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Aboard:
    """All that recognises: the recogniser, its learner (None: nothing is learnt), the reason why it cannot learn (None:
    it can, or is not to), and the seconds that the map took to load."""

    recogniser: Recogniser
    learner: Learner | None
    cannot_learn: str | None
    load_s: float


def fly_course(
    config: Config, board: Board, aboard: Aboard, world: World, *, stop: Stop, reread: Reread | None = None
) -> int:
    """Open links and source, fly, and write the last line of the log; return the exit code, 1 if any frame failed, else
    0. Raises an EdgevprError where links or source cannot be opened, and StopNow where it is to end before that."""
    recogniser, learner, flight_log, tape = aboard.recogniser, aboard.learner, world.flight_log, world.tape
    recogniser.meter = meter_of_queries(config, board, world.clock, tape)
    address, ground_address = parse_links(config.mavlink.link, config.mavlink.ground)
    with ExitStack() as stack:
        with more_time_to_start(), stop.beginning():
            forms = tape.read("forms", lambda: smaller_forms_of(config, recogniser, learner, aboard.load_s))
            found = Outlook(*tape.read("outlook", lambda: astuple(outlook(recogniser, config))))
        recogniser.candidates = found.candidates
        _say_start(config, recogniser, world, found)
        step_s = 1 / rate_hz(config, recogniser)
        navigator = Navigator(config.mavlink.min_accuracy_m, step_s)
        link = ground = None
        if address:
            origin = _first_position(recogniser.place_map) if config.mavlink.set_origin else None
            opened = link_of(
                world.link, address, config.mavlink, navigator, world.signing, tap=world.tap, origin=origin, tape=tape
            )
            link = stack.enter_context(opened)
            link.want_position()
        if link and ground_address:
            ground = stack.enter_context(world.ground(ground_address, link))
        source = world.open_source(step_s)
        stack.callback(source.close)
        if link and not source.is_live:
            _say_recording(config, learner)
        autopilot = _autopilot(config.mavlink, board, navigator, link, world.clock) if link else NoAutopilot()
        if aboard.cannot_learn:
            say_learning_stopped(aboard.cannot_learn, flight_log, autopilot)
        autopilot.announce(Mood.NOTE, f"started, {len(recogniser.place_map)} places", "start")
        notify(READY=1)
        flown = fly(
            recogniser,
            source,
            config,
            flight_log=flight_log,
            autopilot=autopilot,
            stop=stop,
            learner=learner,
            reread=reread,
            fewer_candidates=() if config.match.candidates else trusted_candidates(recogniser.technique),
            smaller_forms=tuple(forms),
            clock=world.clock,
            meter=meter_of_flight(config, board, world.clock, tape),
            readers=world.readers,
        )
        notify(STOPPING=1)
        if link:
            link.close()  # sends waiting messages first, so that the log's last line counts them
            autopilot.log_answers(flight_log)
        flight_log.write(
            "end",
            accepted=flown.accepted,
            unusable=flown.failed,
            **flown.totals,
            mavlink=link.stats() if link else None,
            **({"ground": ground.stats()} if ground else {}),
            **({"learnt": learner.totals} if learner else {}),
        )
        _log.info(
            "%d queries, %d accepted%s, %.3f mAh (%.3f of them for recognising)",
            flown.queries,
            flown.accepted,
            f", {autopilot.summary}" if autopilot.summary else "",
            flown.totals["used_mah"],
            flown.totals["marginal_mah"],
        )
        if learner:
            _log.info("%s, %d in %s", learner.summary, len(recogniser.place_map), config.map)
    return 1 if flown.failed else 0


def recogniser_of(config: Config, board: Board) -> Recogniser:
    """Open the recogniser of a flight that learns nothing."""
    return open_recogniser(config, board, narrowed=True, follows=config.match.follow)


def learning_of(config: Config, board: Board, name: str | None, clock: Clock) -> tuple[Recogniser, Learner]:
    """Open the recogniser of a flight and its learner; a new map is made for the technique of this name."""
    recogniser, growing = open_learning(config, board, name)
    spacing_m, gap_m = config.mapping.spacing_m, config.salience.gap_m
    return recogniser, Learner(recogniser, growing, spacing_m=spacing_m, gap_m=gap_m, utc_clock=clock.utc_s)


def link_of(
    kind: type[Link],
    address: LinkAddress,
    settings: MavlinkConfig,
    navigator: Navigator,
    signing: Signing | NotSigning,
    *,
    tap: Tap = untapped,
    origin: Position | None = None,
    tape: Tape = NO_TAPE,
) -> Link:
    """Make the link to the flight controller, not yet started."""
    return kind(
        address,
        settings.component_id,
        system_id=settings.system_id,
        max_fix_age_s=settings.max_fix_age_s,
        listener=navigator if settings.send_fixes else Muted(navigator),
        tap=tap,
        origin=origin,
        signing=signing,
        tape=tape,
    )


def smaller_forms_of(config: Config, recogniser: Recogniser, learner: Learner | None, load_s: float) -> tuple[str, ...]:
    """List the forms of the index that the governor may take: only for a map that is wholly in memory, does not grow
    and loads quickly. Another form has other scores, so a limit of acceptance set by the user holds for one form only,
    and no other is taken."""
    own_limits = config.match.min_score is not None or config.match.min_margin is not None
    is_whole = len(recogniser.index) == len(recogniser.place_map)  # else a smaller form would hold more places
    if own_limits or learner or not is_whole or load_s > _RELOAD_S:
        return ()
    return trusted_forms(recogniser.technique)


def _autopilot(settings: MavlinkConfig, board: Board, navigator: Navigator, link: Link, clock: Clock) -> ToAutopilot:
    autopilot = ToAutopilot(
        link,
        navigator,
        send_fixes=settings.send_fixes,
        cores=board.cores,
        clock=clock,
        source_sets=SourceSets(settings.source_sets),
    )
    if not settings.send_fixes:
        autopilot.announce(Mood.WARNING, DRY_RUN)
    return autopilot


def _first_position(place_map: PlaceMap) -> Position | None:
    return next((place.position for place in place_map.places() if place.position), None)


def _say_start(config: Config, recogniser: Recogniser, world: World, found: Outlook) -> None:
    """Say which technique flies, and write the first line of the log."""
    board = recogniser.meter.board
    _log.info("version %s on %s", __version__, board.title)
    _log.info("%s", found.reason)
    if not config.mavlink.send_fixes:
        _log.warning("%s", DRY_RUN)
    if config.mavlink.link and config.mavlink.send_fixes and (found.t_query_s or 0.0) > FIX_MAX_AGE_S:
        _log.warning("no fix will be sent: %s", too_late(found.t_query_s))
    if not board.verified:
        _log.warning("mAh are estimates: the power of %s is unverified (%s)", board.title, board.source)
    decided: dict[str, Any] = {
        "reason": found.reason,
        "rule": recogniser.rule,
        "candidates": recogniser.candidates,
        "sequence": recogniser.search.length,
        "accuracy_m": recogniser.accuracy_m,
        "rate_hz": rate_hz(config, recogniser),
        "idle_w": board.idle_w,
        "full_w": board.full_w,
        "power_verified": board.verified,
        "dry_run": not config.mavlink.send_fixes,
    }
    fields = start_fields(config, board.name, recogniser.technique.spec, recogniser.place_map)
    world.flight_log.write("start", **fields, recording=world.recording, decided=decided)


def _say_recording(config: Config, learner: Learner | None) -> None:
    uri = config.source.uri
    if config.mavlink.send_fixes:
        _log.warning("%s is a recording: the fixes sent say where it was made, not where you are", uri)
    if learner:
        _log.warning("%s is a recording: what it learns is put where the vehicle is now", uri)
