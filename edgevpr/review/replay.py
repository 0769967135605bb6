"""Replays a recorded flight, for `edgevpr replay`: runs its code with clocks, frames and messages of the recording."""

import logging
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from edgevpr.core.arrays import Image
from edgevpr.core.config import Config, build, list_keys
from edgevpr.core.errors import EdgevprError, ImageError, UsageError
from edgevpr.core.text import show_progress
from edgevpr.frames.images import read_image
from edgevpr.mavlink.signing import NOT_SIGNING
from edgevpr.power.boards import Board, resolve_board
from edgevpr.power.thermal import ThermalWatch
from edgevpr.review import tape
from edgevpr.review.compare import Line, PacketComparison
from edgevpr.runtime.flight.boundary import TapedStop, TapedTurns, tape_clock, tape_machine
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.flight import Flight
from edgevpr.runtime.flight.flightio import FlightIO
from edgevpr.runtime.flight.flightlog import read_log
from edgevpr.runtime.flight.machine import Machine
from edgevpr.runtime.flight.recording import TAPE, frame_path, read_recorded

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayResult:
    """Result of a replay. `flown`: lines of the flight's log. `lines`: lines of the replay's log. `packets`: comparison
    of the packets of both. `why_ended`: why the replay ended before the flight (None: it did not). `guessed`: number of
    inputs that were not on the tape where the code read them (see `Playback`)."""

    flown: list[Line]
    lines: list[Line]
    packets: PacketComparison
    why_ended: str | None
    guessed: int


def replay(log: str | Path, place_map: str | None = None) -> ReplayResult:
    """Replay the last flight in `log`. Its recording is in the folder that the log names, or in a folder of the same
    name next to the log. `place_map`: path of its map (None: its recorded path). Raises UsageError if there is no
    recording, and EdgevprError if the recording or the map cannot be opened."""
    flown, folder = read_recorded(log)
    notes = tape.read_tape(folder / TAPE)
    note = next(notes, None)
    if not (note and note[0] == "flight" and isinstance(note[1], dict)):
        raise EdgevprError(f"{folder / TAPE} is not a flight tape, or ends within its first line: nothing to replay.")
    header = note[1]
    if header["config"].get("mavlink", {}).get("ground"):
        raise UsageError(
            f"{folder} is from a flight with a second link (`mavlink.ground`), which this version of edgevpr does not "
            f"have: replay it with edgevpr {header['version']}."
        )
    config = build(Config, _drop_unknown_settings(header["config"], Config), str(folder))
    place_map = place_map or config.map
    if place_map and not Path(place_map).exists():
        raise UsageError(f"{place_map}, the map of the flight, does not exist: pass its path with --map.")
    playback = tape.Playback(notes)
    recorded = build(Board, _drop_unknown_settings(header["board"], Board), "the board of the flight")
    board = resolve_board(recorded, config.source, config.memory)
    why_ended = None
    with TemporaryDirectory(prefix="edgevpr-replay-") as temporary:
        replay_log = f"{temporary}/flight.jsonl" if config.log.path else None
        io = FlightIO(
            board=board,
            place_map=place_map,
            log=replace(config.log, path=replay_log, max_mb=None),
            clock=tape_clock(Clock(sleep=playback.sleep), playback),
            machine=tape_machine(Machine(measure_heat=ThermalWatch(hot_c=board.thermal_limit_c).read), playback),
            open_source=lambda *_: tape.ReplayedSource(playback, partial(_read_frame, folder)),
            turns=TapedTurns(Clock().mono_s, playback),
            drive=partial(tape.ReplayedDriver, playback),
            signing=tape.ReplayedSigning() if config.mavlink.signing_key else NOT_SIGNING,
            stop=TapedStop(playback),
            status=None,
            recording=header["recording"],
        )
        # Of the replayed flight, only errors are logged (with --debug: all messages).
        logging.disable(logging.NOTSET if _log.isEnabledFor(logging.DEBUG) else logging.WARNING)
        try:
            with closing(Flight.open(config, io)) as flight:
                flight.run()
        except tape.TapeEnded as end:
            why_ended = str(end) or "the recording ends there"
        finally:
            logging.disable(logging.NOTSET)
        show_progress("")
        lines = list(read_log(replay_log)) if replay_log else []
        return ReplayResult(
            flown=flown, lines=lines, packets=playback.packets, why_ended=why_ended, guessed=playback.guessed
        )


def _read_frame(folder: Path, number: int) -> Image:
    """Read a recorded frame. Raises TapeEnded if it cannot be read, for example after a power cut."""
    show_progress(f"replaying  {number}")
    try:
        return read_image(frame_path(folder, number))
    except ImageError as error:
        raise tape.TapeEnded(str(error)) from None


def _drop_unknown_settings(recorded: dict[str, Any], kind: type, prefix: str = "") -> dict[str, Any]:
    """Return the settings of a recorded flight, of the dataclass `kind`, without unknown ones, with a warning."""
    settings, known_names = {}, {key.name for key in list_keys(kind)}
    for name, value in recorded.items():
        key_name = f"{prefix}{name}"
        if key_name in known_names:
            settings[name] = value
        elif isinstance(value, dict):
            settings |= {name: section} if (section := _drop_unknown_settings(value, kind, f"{key_name}.")) else {}
        elif value not in (None, False):
            _log.warning("the flight had the setting `%s`, which this version of edgevpr does not recognise", key_name)
    return settings
