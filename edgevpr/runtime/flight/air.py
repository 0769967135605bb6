"""Making of the `World` of a real flight: its cameras, clocks and links, and a recording of all input if one is
configured. `flight.fly` uses it; a replay makes a `World` of its own."""

import ctypes
import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

from edgevpr import __version__
from edgevpr.core.config import Config
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.types import NO_TAPE, Tape
from edgevpr.frames.source import Source, open_source
from edgevpr.frames.taped import RecordedSource
from edgevpr.mavlink.address import parse_links
from edgevpr.mavlink.groundlink import GroundLink
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.signing import open_signing
from edgevpr.mavlink.tlog import Tlog
from edgevpr.mavlink.wire import untapped
from edgevpr.power.boards import load_board
from edgevpr.runtime.flight import systemd
from edgevpr.runtime.flight.clock import Clock, taped
from edgevpr.runtime.flight.recording import Recording
from edgevpr.runtime.flight.status import StatusFile, usual_path
from edgevpr.runtime.flight.world import Stop, World
from edgevpr.runtime.recognise.learn import check_positions
from edgevpr.runtime.recognise.opening import has_map

T = TypeVar("T")

_log = logging.getLogger(__name__)

# Parameters of `mallopt` (glibc's malloc.h) and their values, bytes: how much of what was freed is kept, and from which
# size on a part of memory is given back to the system as soon as it is freed. Left alone, glibc raises both as larger
# parts are freed: a flight over many places then holds more than it uses. At half of these it is slower.
_MALLOC = {-1: 8_000_000, -3: 4_000_000}


@contextmanager
def in_the_air(config: Config, positions: Path | None = None) -> Iterator[World]:
    """Open all inputs and outputs of a real flight, yield them, and close them at the end. `positions` is a file with
    the positions of the frames, if the source is a recording (None: there is none). Raises an EdgevprError if something
    cannot be opened."""
    if config.source.uri is None:
        raise UsageError("There is no source of frames: name one with --source, or `source: {uri: ...}`.")
    parse_links(config.mavlink.link, config.mavlink.ground)
    if config.mapping.learn:
        check_positions(config, positions)
    board, uri = load_board(config.board), config.source.uri
    _give_back_freed_memory()
    with ExitStack() as stack:
        recording = _or_without(lambda: _recording(config, stack))
        tape: Tape = recording or NO_TAPE
        if recording:
            tape.note(
                "flight",
                {
                    "version": __version__,
                    "config": asdict(config),
                    "board": asdict(board),
                    "recording": str(recording.path.resolve()),
                },
            )
        status_path = config.status.file or usual_path()
        status = _or_without(lambda: stack.enter_context(StatusFile(status_path))) if status_path else None
        if config.log.tlog and not config.mavlink.link:
            _log.warning("there is no link, so there is no tlog either")
        tlog_path = config.log.tlog if config.mavlink.link else None
        tlog = _or_without(lambda: stack.enter_context(Tlog(tlog_path))) if tlog_path else None

        def opened_source(step_s: float) -> Source:
            source = open_source(uri, step_s=step_s, positions=positions, live=True)
            return RecordedSource(source, recording, recording.keep) if recording else source

        yield World(
            board=board,
            place_map=config.map,
            log=config.log,
            tape=tape,
            clock=taped(Clock(), tape) if recording else Clock(),
            open_source=opened_source,
            link=Link,
            ground=GroundLink,
            signing=open_signing(config.mavlink.signing_key, config.mavlink.signing_state),
            tap=tlog.record if tlog else untapped,
            stop=Stop(tape),
            status=status,
            recording=str(recording.path.resolve()) if recording else None,
        )


def _give_back_freed_memory() -> None:
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):  # musl has none
        for parameter, value in _MALLOC.items():
            mallopt(parameter, value)


def _recording(config: Config, stack: ExitStack) -> Recording | None:
    """Begin the recording, which `stack` closes; return None if none is configured."""
    if config.log.record is None:
        return None
    recording = stack.enter_context(Recording(config.log.record, config.log.record_mb))
    if config.mapping.learn and config.map and has_map(Path(config.map)):
        recording.keep_map(Path(config.map))
    return recording


def _or_without(opened: Callable[[], T]) -> T | None:
    """Return the result of `opened`. If that raises an EdgevprError in a systemd service, which may be restarted in the
    air, log it and return None, so that the flight goes on without."""
    try:
        return opened()
    except EdgevprError as error:
        if not systemd.is_there():
            raise
        _log.warning("%s", error)
        return None
