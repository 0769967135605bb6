"""Writing a profile of this machine, for `edgevpr profile --detect` and `--measure`."""

import sys
from datetime import datetime
from pathlib import Path

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.files import require_folder, write_whole
from edgevpr.power.boards import MachineSpeed

_ENDINGS = (".yaml", ".yml")


def require_new_profile(path: Path) -> None:
    """Raise UsageError where `write_profile` could not write."""
    if path.suffix not in _ENDINGS:
        raise UsageError(f"{path}: a profile's name ends in .yaml: choose such a name.")
    require_folder(path)
    if path.exists():
        raise UsageError(f"{path} is there already: move it away, or choose another name.")


def write_profile(path: Path, text: str) -> None:
    """Write a profile that does not exist yet, completely or not at all. Raises EdgevprError where the file has
    appeared meanwhile."""
    try:
        write_whole(path, lambda unfinished: unfinished.write_text(text, "utf-8"), instead=False)
    except FileExistsError:
        raise EdgevprError(f"{path} is there already: move it away, or choose another name.") from None


def measured_profile(figures: Path, score: MachineSpeed) -> tuple[Path | None, str]:
    """Measure idle and load power (minutes), where this machine has a power meter, and write a profile beside the file
    `figures`. Returns the path of the profile (None: no meter can be read) and a sentence. Raises MeterError."""
    from edgevpr.power.calibrate import LOADS, calibrate
    from edgevpr.power.detect import detect, profile_text
    from edgevpr.power.sensors import find_meters

    found = find_meters()
    if not found.meters:
        return None, " ".join(found.notes)
    meter = found.meters[0]
    held = iter(range(1, len(LOADS) + 1))
    calibration = calibrate(
        meter,
        progress=lambda share: print(
            f"measuring power with the {meter.title}  {next(held)}/{len(LOADS)}  load {share:.0%}", file=sys.stderr
        ),
    )
    path = figures.with_name(f"{figures.stem}-{datetime.now():%Y%m%d-%H%M%S}.yaml")
    write_profile(path, profile_text(detect(), score, calibration))
    fit = calibration.fit
    return path, (
        f"Power: {fit.idle_w:.3g} W idle, {fit.full_w:.3g} W with every core busy, by the {meter.title} "
        f"(residual {fit.residual_w:.2g} W, R2 {fit.r2:.3f}); written to {path}: use it with --board {path}."
    )
