"""All inputs and outputs of a flight. In the air (`open_real_io`) these are real cameras, clocks and a link, with a
recording if one is configured; in a replay they come from the recording."""

import ctypes
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from edgevpr import __version__
from edgevpr.core.config import Config, LogConfig
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.frames.source import Source, open_source
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.driver import DriverMaker, PortDriver
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.signing import Signing, open_signing
from edgevpr.mavlink.turns import Turns
from edgevpr.power.boards import Board, load_board, resolve_board
from edgevpr.power.thermal import ThermalWatch
from edgevpr.runtime.flight import boundary, systemd
from edgevpr.runtime.flight.autopilot import AutopilotOutput
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.machine import Machine
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.notifier import Notifier
from edgevpr.runtime.flight.recording import Recording
from edgevpr.runtime.flight.status import StatusFile, find_default_path
from edgevpr.runtime.flight.stop import Stop
from edgevpr.runtime.recognise.recogniser import Recogniser

T = TypeVar("T")

_log = logging.getLogger(__name__)

# Parameters of `mallopt` (glibc's malloc.h), bytes: how much freed memory is kept, and the size above which it is
# returned at once. glibc raises both by default, so a flight over many places would keep memory. Half is slower.
_MALLOC_OPTIONS = {-1: 8_000_000, -3: 4_000_000}
_MAX_WARNING_S = 0.3  # longest wait for the last log line
_MAX_END_S = 4.0  # from a signal until a process that hangs is killed: systemd waits five seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightIO:
    """Inputs and outputs of a flight. `place_map`: path of the map; `log`: settings of the flight log; `open_source`:
    opens the source, given the seconds between two frames, and `upright` as in `frames.source.open_source`; `turns`,
    `drive` and `signing`: the link's turns, maker of its driver, and packet signing; `status`: the status file;
    `recording`: its folder (None: no such file). All input passes here; `boundary` records it or plays it back."""

    board: Board
    place_map: str | None
    log: LogConfig
    clock: Clock
    machine: Machine
    open_source: Callable[[float, bool], Source]
    turns: Turns
    drive: DriverMaker
    signing: Signing
    stop: Stop
    status: StatusFile | None
    recording: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightParts:
    """All open parts of a flight (None: there is no such part)."""

    recogniser: Recogniser
    source: Source
    link: Link | None = None
    autopilot: AutopilotOutput | None = None
    flight_log: FlightLog
    notifier: Notifier
    meter: FlightMeter
    io: FlightIO


@contextmanager
def open_real_io(config: Config, positions: Path | None = None, steps_s: Sequence[float] = ()) -> Iterator[FlightIO]:
    """Open the inputs and outputs of a real flight, yield them and close them; meanwhile SIGTERM and SIGINT end the
    flight. If the source is a recording, `positions` is the file with the positions of its frames, and `steps_s` the
    seconds between them (empty: they are read at the configured rate). Raises EdgevprError."""
    source = config.source
    if (uri := source.uri) is None:
        raise UsageError("There is no source of frames: set --source or `source: {uri: ...}`.")
    if config.mavlink.link is not None:
        parse_link(config.mavlink.link)
    board = resolve_board(load_board(config.board), source, config.memory)
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):  # musl has none
        for parameter, value in _MALLOC_OPTIONS.items():
            mallopt(parameter, value)
    with ExitStack() as stack:
        log, record = config.log, config.log.record
        recording = _open_optional(lambda: stack.enter_context(Recording(record, log.record_mb))) if record else None
        folder = str(recording.path.resolve()) if recording else None
        status_path = config.status.file or find_default_path()
        status = _open_optional(lambda: stack.enter_context(StatusFile(status_path))) if status_path else None

        def open_paced(step_s: float, upright: bool) -> Source:
            source = open_source(uri, step_s=step_s, positions=positions, live=True, steps_s=steps_s, upright=upright)
            if steps_s:
                _log.info("playing %d pictures at their recorded times, over %.0f s", source.total, sum(steps_s))
            elif Path(uri).is_dir():
                _log.info("playing pictures in order at %.3g Hz, because not all have a time", 1 / step_s)
            return source

        io = FlightIO(
            board=board,
            place_map=config.map,
            log=config.log,
            clock=Clock(),
            machine=Machine(measure_heat=ThermalWatch(hot_c=board.thermal_limit_c).read),
            open_source=open_paced,
            turns=Turns(Clock().mono_s),
            drive=PortDriver,
            signing=open_signing(config.mavlink),
            stop=Stop(),
            status=status,
            recording=folder,
        )
        if recording:
            header = {"version": __version__, "config": asdict(config), "board": asdict(board), "recording": folder}
            recording.note("flight", header)
            io = record_io(io, recording)
        with _handle_signals(io.stop):
            yield io


def record_io(io: FlightIO, recording: Recording) -> FlightIO:
    """Return the same inputs and outputs, with all input recorded."""
    turns = boundary.TapedTurns(io.clock.mono_s, recording)
    return replace(
        io,
        clock=boundary.tape_clock(io.clock, recording),
        machine=boundary.tape_machine(io.machine, recording),
        open_source=lambda *how: boundary.RecordedSource(io.open_source(*how), recording, recording.store_frame),
        turns=turns,
        drive=partial(boundary.RecordedDriver, turns),
        stop=boundary.TapedStop(recording),
    )


def _open_optional(open_part: Callable[[], T]) -> T | None:
    """Return the result of `open_part`; None, with a warning, if it fails in a service, which can fly without it."""
    try:
        return open_part()
    except EdgevprError as error:
        if not systemd.is_service():
            raise
        _log.warning("%s", error)
        return None


@contextmanager
def _handle_signals(stop: Stop) -> Iterator[None]:
    """Context manager: SIGTERM and SIGINT call `stop`, and kill the process if it still runs after four seconds.
    SIGHUP is ignored: closing a terminal must not end a flight."""
    handlers: dict[signal.Signals, Stop | signal.Handlers] = {signal.SIGTERM: stop, signal.SIGINT: stop}
    handlers[signal.SIGHUP] = signal.SIG_IGN
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    # Python calls `stop` in the main thread, which may hang, but writes the signal number to the pipe at once.
    before_writer = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    has_ended = threading.Event()
    watch = threading.Thread(target=_force_exit_if_hung, args=(reader, has_ended), name="end", daemon=True)
    watch.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before_writer)
        for number, handler in before.items():
            signal.signal(number, handler)
        has_ended.set()
        os.close(writer)
        watch.join()
        os.close(reader)


def _force_exit_if_hung(reader: int, has_ended: threading.Event) -> None:
    """Kill the process if a signal arrives through the pipe `reader` and `has_ended` is not set soon after. By then the
    flight log has been written."""
    while number := os.read(reader, 1):
        if number[0] in (signal.SIGTERM, signal.SIGINT) and not has_ended.wait(_MAX_END_S):
            text = "the flight did not stop on the signal: killing the process"
            # In a thread, because the hanging thread may be inside a log call.
            warning = threading.Thread(target=_log.warning, args=(text,), daemon=True)
            warning.start()
            warning.join(_MAX_WARNING_S)
            os._exit(1)
