"""A flight from start to end: everything is opened, flown with, and closed; SIGTERM and SIGINT end it, SIGHUP has
its configuration read again."""

import logging
import os
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from edgevpr import __version__
from edgevpr.config import Config, MavlinkConfig
from edgevpr.errors import EdgevprError, MapError, UsageError
from edgevpr.frames.source import open_source
from edgevpr.mavlink.address import LinkAddress, parse_links
from edgevpr.mavlink.ground import GroundLink
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.signing import open_signing
from edgevpr.mavlink.tlog import Tlog
from edgevpr.mavlink.wire import Tap, untapped
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import Board, load_board
from edgevpr.runtime.flight.autopilot import DRY_RUN, Mood, NoAutopilot, ToAutopilot
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.flight import fly as fly_with
from edgevpr.runtime.flight.flight import rate_hz
from edgevpr.runtime.flight.flightlog import FlightLog, start_fields
from edgevpr.runtime.flight.learning import say_learning_stopped
from edgevpr.runtime.flight.loop import Stop
from edgevpr.runtime.flight.navigator import Muted, Navigator
from edgevpr.runtime.flight.reloading import Reread
from edgevpr.runtime.flight.sourcesets import SourceSets
from edgevpr.runtime.flight.statussocket import NoReaders, Readers, StatusSocket, usual_path
from edgevpr.runtime.flight.systemd import notify
from edgevpr.runtime.preflight.choose import too_late
from edgevpr.runtime.preflight.pick import Outlook, outlook, picked_technique, trusted_candidates, trusted_forms
from edgevpr.runtime.recognise.learn import Learner, check_positions
from edgevpr.runtime.recognise.opening import has_map, open_learning, open_recogniser
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.types import FIX_MAX_AGE_S, Position

_RELOAD_S = 10.0  # a map that takes longer to load is not loaded again in flight: nothing is recognised meanwhile
_NEW_MAP_PLACES = 1000  # a technique picked for an empty map must be able to fly with so many

_log = logging.getLogger(__name__)


def fly(config: Config, positions: Path | None = None, reread: Reread | None = None) -> int:
    """Open everything, fly, close everything; return the exit code, 1 if any frame failed, else 0. `reread` is asked by
    SIGHUP. Raises an EdgevprError, one sentence, where the flight cannot start."""
    if config.source.uri is None:
        raise UsageError("There is no source of frames: name one with --source, or `source: {uri: ...}`.")
    address, ground = parse_links(config.mavlink.link, config.mavlink.ground)
    if config.mapping.learn:
        check_positions(config, positions)
    board = load_board(config.board)
    with ExitStack() as stack:
        begin_s = time.monotonic()
        recogniser, learner, cannot_learn = _opened(config, board)
        stack.callback(recogniser.place_map.close)
        smaller_forms = smaller_forms_of(config, recogniser, learner, time.monotonic() - begin_s)
        flight_log = stack.enter_context(
            FlightLog(config.log.path, wait="NOTIFY_SOCKET" in os.environ, max_mb=config.log.max_mb)
        )
        readers = stack.enter_context(_readers(config))
        found = outlook(recogniser, config)
        recogniser.candidates = found.candidates
        _say_start(config, recogniser, flight_log, found)
        step_s = 1 / rate_hz(config, recogniser)
        navigator = Navigator(config.mavlink.min_accuracy_m, step_s)
        tap = _tap(stack, config)
        origin = _first_position(recogniser.place_map) if config.mavlink.set_origin else None
        link = stack.enter_context(_link(address, config.mavlink, navigator, tap, origin)) if address else None
        if link:
            link.want_position()
        ground_link = stack.enter_context(GroundLink(ground, link)) if link and ground else None
        source = open_source(config.source.uri, step_s=step_s, positions=positions, live=True)
        stack.callback(source.close)
        if link and not source.is_live:
            _say_recording(config, learner)
        autopilot = NoAutopilot()
        if link:
            send_fixes = config.mavlink.send_fixes
            autopilot = ToAutopilot(
                link,
                navigator,
                send_fixes=send_fixes,
                cores=board.cores,
                clock=Clock(),
                source_sets=SourceSets(config.mavlink.source_sets),
            )
            if not send_fixes:
                autopilot.announce(Mood.WARNING, DRY_RUN)
        if cannot_learn:
            say_learning_stopped(cannot_learn, flight_log, autopilot)
        stop = Stop()
        with _signals(stop, reread):
            notify(READY=1)
            flown = fly_with(
                recogniser,
                source,
                config,
                flight_log=flight_log,
                autopilot=autopilot,
                stop=stop,
                learner=learner,
                reread=reread,
                fewer_candidates=() if config.match.candidates else trusted_candidates(recogniser.technique),
                smaller_forms=smaller_forms,
                readers=readers,
            )
            notify(STOPPING=1)
        if link:
            link.close()  # sends waiting messages first, so that the log's last line counts them
            autopilot.answers.write(flight_log)
        flight_log.write(
            "end",
            accepted=flown.accepted,
            unusable=flown.failed,
            **flown.totals,
            mavlink=link.stats() if link else None,
            **({"ground": ground_link.stats()} if ground_link else {}),
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


def _link(
    address: LinkAddress,
    settings: MavlinkConfig,
    navigator: Navigator,
    tap: Tap = untapped,
    origin: Position | None = None,
) -> Link:
    return Link(
        address,
        settings.component_id,
        system_id=settings.system_id,
        max_fix_age_s=settings.max_fix_age_s,
        listener=navigator if settings.send_fixes else Muted(navigator),
        tap=tap,
        origin=origin,
        signing=open_signing(settings.signing_key, settings.signing_state),
    )


def _first_position(place_map: PlaceMap) -> Position | None:
    return next((place.position for place in place_map.places() if place.position), None)


def _tap(stack: ExitStack, config: Config) -> Tap:
    """Open the tlog, if there is to be one, and return the call that takes its packets. A service, which may restart in
    the air, flies without one that cannot be opened."""
    if config.log.tlog is None:
        return untapped
    if config.mavlink.link is None:
        _log.warning("there is no link, so there is no tlog either")
        return untapped
    try:
        return stack.enter_context(Tlog(config.log.tlog)).record
    except EdgevprError as error:
        if "NOTIFY_SOCKET" not in os.environ:
            raise
        _log.warning("%s", error)
        return untapped


def _readers(config: Config) -> Readers:
    """Open the status socket, if there is to be one. A service flies without one that cannot be opened."""
    path = config.status.socket or usual_path()
    if path is None:
        return NoReaders()
    try:
        return StatusSocket(path)
    except EdgevprError as error:
        if "NOTIFY_SOCKET" not in os.environ:
            raise
        _log.warning("%s", error)
        return NoReaders()


def _opened(config: Config, board: Board) -> tuple[Recogniser, Learner | None, str | None]:
    """Open the recogniser of a flight and its learner, if it is to have one.

    Where the map cannot be written (a card that has become read-only, a full disk), return the recogniser alone, and
    the reason: the places of the map are recognised all the same.
    """
    if not config.mapping.learn:
        return open_recogniser(config, board, narrowed=True, follows=config.match.follow), None, None
    name = config.technique
    if name is None and config.map is not None and not has_map(Path(config.map)):
        name = picked_technique(config.board, _NEW_MAP_PLACES, config.source.camera)
    try:
        recogniser, growing = open_learning(config, board, name)
    except MapError as error:
        try:
            return open_recogniser(config, board, narrowed=True, follows=config.match.follow), None, str(error)
        except MapError:
            raise error from None
    return (
        recogniser,
        Learner(recogniser, growing, spacing_m=config.mapping.spacing_m, gap_m=config.salience.gap_m),
        None,
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


def _say_start(config: Config, recogniser: Recogniser, flight_log: FlightLog, found: Outlook) -> None:
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
    flight_log.write("start", **start_fields(config, board.name, recogniser.technique.spec), decided=decided)


def _say_recording(config: Config, learner: Learner | None) -> None:
    uri = config.source.uri
    if config.mavlink.send_fixes:
        _log.warning("%s is a recording: the fixes sent say where it was made, not where you are", uri)
    if learner:
        _log.warning("%s is a recording: what it learns is put where the vehicle is now", uri)


@contextmanager
def _signals(stop: Stop, reread: Reread | None) -> Iterator[None]:
    """Let SIGTERM and SIGINT end the flight inside this context, and SIGHUP have its configuration read again."""
    handlers = {signal.SIGTERM: stop, signal.SIGINT: stop} | ({signal.SIGHUP: reread} if reread else {})
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
