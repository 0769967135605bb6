"""A flight from start to end: everything is opened, flown with, and closed; SIGTERM and SIGINT end it, SIGHUP has
its configuration read again."""

import logging
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

from edgevpr import __version__
from edgevpr.core.config import Config
from edgevpr.core.errors import EdgevprError, MapError, UsageError
from edgevpr.core.types import NO_TAPE, Tape
from edgevpr.frames.source import Source, open_source
from edgevpr.frames.taped import RecordedSource
from edgevpr.mavlink.address import parse_links
from edgevpr.mavlink.ground import GroundLink
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.signing import open_signing
from edgevpr.mavlink.tlog import Tlog
from edgevpr.mavlink.wire import Tap, untapped
from edgevpr.power.boards import Board, load_board
from edgevpr.runtime.flight.clock import Clock, taped
from edgevpr.runtime.flight.course import Aboard, World, fly_course, learning_of, recogniser_of
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.loop import Stop, StopNow
from edgevpr.runtime.flight.recording import Recording
from edgevpr.runtime.flight.reloading import Reread
from edgevpr.runtime.flight.statussocket import NoReaders, Readers, StatusSocket, usual_path
from edgevpr.runtime.flight.systemd import more_time_to_start
from edgevpr.runtime.preflight.pick import picked_technique
from edgevpr.runtime.recognise.learn import check_positions
from edgevpr.runtime.recognise.opening import has_map

_NEW_MAP_PLACES = 1000  # a technique picked for an empty map must be able to fly with so many

T = TypeVar("T")

_log = logging.getLogger(__name__)


def fly(config: Config, positions: Path | None = None, read_again: Callable[[], Config] | None = None) -> int:
    """Open everything, fly, close everything; return the exit code, 1 if any frame failed, else 0. `read_again` reads
    the configuration anew, when SIGHUP asks for that. Raises an EdgevprError, one sentence, where the flight cannot
    start."""
    if config.source.uri is None:
        raise UsageError("There is no source of frames: name one with --source, or `source: {uri: ...}`.")
    parse_links(config.mavlink.link, config.mavlink.ground)
    if config.mapping.learn:
        check_positions(config, positions)
    board = load_board(config.board)
    with ExitStack() as stack:
        recording = _recording(stack, config, board, is_reread=read_again is not None)
        tape: Tape = recording or NO_TAPE
        clock = taped(Clock(), tape) if recording else Clock()
        with more_time_to_start():
            aboard = _opened(config, board, clock, tape)
        stack.callback(aboard.recogniser.place_map.close)
        flight_log = stack.enter_context(
            FlightLog(
                config.log.path,
                clock.mono_s,
                clock.utc_s,
                wait="NOTIFY_SOCKET" in os.environ,
                max_mb=config.log.max_mb,
                tape=tape,
            )
        )

        def opened_source(step_s: float) -> Source:
            source = open_source(config.source.uri, step_s=step_s, positions=positions, live=True)
            return RecordedSource(source, recording, recording.keep) if recording else source

        world = World(
            tape=tape,
            clock=clock,
            flight_log=flight_log,
            readers=stack.enter_context(_readers(config)),
            open_source=opened_source,
            link=Link,
            ground=GroundLink,
            signing=open_signing(config.mavlink.signing_key, config.mavlink.signing_state),
            tap=_tap(stack, config),
            recording=str(recording.path.resolve()) if recording else None,
        )
        stop, reread = Stop(tape), Reread(read_again, tape) if read_again else None
        with _signals(stop, reread):
            try:
                return fly_course(config, board, aboard, world, stop=stop, reread=reread)
            except StopNow:
                _log.info("stopped before the flight began")
                return 0


def _recording(stack: ExitStack, config: Config, board: Board, is_reread: bool) -> Recording | None:
    """Begin the recording, if there is to be one."""
    if config.log.record is None:
        return None

    def begun() -> Recording:
        recording = stack.enter_context(Recording(config.log.record, config.log.record_mb))
        if config.mapping.learn and config.map and has_map(Path(config.map)):
            recording.keep_map(Path(config.map))
        return recording

    recording = _or_without(begun, None)
    if recording is None:
        return None
    recording.note(
        "flight",
        {
            "version": __version__,
            "config": asdict(config),
            "board": asdict(board),
            "is_reread": is_reread,
            "recording": str(recording.path.resolve()),
        },
    )
    return recording


def _tap(stack: ExitStack, config: Config) -> Tap:
    """Open the tlog, if there is to be one, and return the call that takes its packets."""
    if config.log.tlog is None:
        return untapped
    if config.mavlink.link is None:
        _log.warning("there is no link, so there is no tlog either")
        return untapped
    return _or_without(lambda: stack.enter_context(Tlog(config.log.tlog)).record, untapped)


def _readers(config: Config) -> Readers:
    """Open the status socket, if there is to be one."""
    path = config.status.socket or usual_path()
    return NoReaders() if path is None else _or_without(lambda: StatusSocket(path), NoReaders())


def _or_without(opened: Callable[[], T], without: T) -> T:
    """Return what is `opened`. A service, which may restart in the air, flies `without` what cannot be opened."""
    try:
        return opened()
    except EdgevprError as error:
        if "NOTIFY_SOCKET" not in os.environ:
            raise
        _log.warning("%s", error)
        return without


def _opened(config: Config, board: Board, clock: Clock, tape: Tape) -> Aboard:
    """Open the recogniser of a flight and its learner, if it is to have one.

    Where the map cannot be written (a card that has become read-only, a full disk), the recogniser alone is opened: the
    places of the map are recognised all the same.
    """
    begin_s = time.monotonic()
    name = config.technique
    if config.mapping.learn and name is None and config.map is not None and not has_map(Path(config.map)):
        name = picked_technique(config.board, _NEW_MAP_PLACES, config.source.camera)
    tape.note("picked", name)
    opened = cannot_learn = None
    if config.mapping.learn:
        try:
            opened = learning_of(config, board, name, clock)
        except MapError as error:
            cannot_learn = error
    tape.note("cannot_learn", cannot_learn and str(cannot_learn))
    try:
        recogniser, learner = opened or (recogniser_of(config, board), None)
    except MapError:
        if cannot_learn:
            raise cannot_learn from None
        raise
    return Aboard(
        recogniser=recogniser,
        learner=learner,
        cannot_learn=cannot_learn and str(cannot_learn),
        load_s=time.monotonic() - begin_s,
    )


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
