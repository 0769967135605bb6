"""This machine as a board: its profile, written with the speed and the power that are measured here, and the speed from
which costs measured here are scaled."""

import sys
from dataclasses import replace
from pathlib import Path

from edgevpr.core.errors import UsageError
from edgevpr.core.files import require_folder, write_whole
from edgevpr.power.boards import Board, own_profile, profile_text
from edgevpr.power.speed import micro_benchmark
from edgevpr.runtime.preflight.scale import is_same


def write_profile(path: Path) -> str:
    """Measure this machine and write its profile to a new file, completely or not at all: the speed by the
    micro-benchmark (two seconds), the power by the machine's meter, if it has one (a minute). Returns a sentence on
    the power.

    Raises UsageError before the work if the name does not end in .yaml, the folder does not exist, or the file exists
    already; MeterError for a meter that fails.
    """
    from edgevpr.power.calibrate import NO_METER, calibrate, find_meters

    if path.suffix not in (".yaml", ".yml"):
        raise UsageError(f"{path}: a profile's name ends in .yaml: choose such a name.")
    require_folder(path)
    if path.exists():
        raise UsageError(f"{path} is there already: move it away, or choose another name.")
    board, power = own_profile(micro_benchmark()), NO_METER
    if meter := next(iter(find_meters()), None):
        said = f"measuring power with the {meter.title}: load"
        board = calibrate(board, meter, progress=lambda share: print(f"{said} {share:.0%}", file=sys.stderr))
        power = f"Power: {board.idle_w:.3g} W idle, {board.full_w:.3g} W with every core busy: {board.source}."
    write_whole(path, lambda unfinished: unfinished.write_text(profile_text(board), "utf-8"))
    return power


def scaled_from(here: Board, board: Board) -> Board:
    """Return the machine `here` with the speed score from which its costs are scaled to `board`. Both scores must be
    of one kind: that of the profile of `here` if it is verified and `board` has a published score only (no `passes`),
    else that of the micro-benchmark, run now."""
    published = here.benchmark_score.verified and board.benchmark_score.passes is None
    if is_same(here, board) or published:
        return here
    return replace(here, benchmark_score=micro_benchmark())
