"""Mean power over a time, from a meter: trapezoids between readings of watts, or differences of counters of joules."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from edgevpr.core.errors import UsageError
from edgevpr.power.powermeter import ABSURD_W, Meter, MeterError, PowerSample

_GONE_AFTER = 3  # failures in a row: the meter is gone, and a mean from before would hide it


@dataclass(frozen=True, slots=True)
class MeanPower:
    """Mean power over `window_s`, the time between the first and the last good reading; `skipped` readings failed."""

    mean_w: float
    window_s: float
    readings: int
    skipped: int


def mean_power(
    meter: Meter,
    window_s: float,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> MeanPower:
    """Read `meter` every `meter.period_s` for `window_s` seconds and return the mean power.

    A reading that fails (file gone, no number, negative, absurd) is left out and counted; its neighbours bridge the
    gap. Raises MeterError when three fail in a row, when fewer than two are good, or when more than half have failed,
    and UsageError for a time that is not above 0. Short windows say little: one study had to read at 350 Hz to trust
    them, so let the same work run for many seconds.
    """
    if not 0 < window_s < float("inf"):
        raise UsageError(f"Power cannot be measured for {window_s:g} s: give a time above 0.")
    start_s = clock()
    # At least two readings, the last one at the very end.
    steps = max(1, round(window_s / meter.period_s))
    first = last = None
    energy_j, readings, skipped, failed_in_a_row = 0.0, 0, 0, 0
    for step in range(steps + 1):
        sleep(max(0.0, start_s + window_s * step / steps - clock()))
        try:
            sample = meter.read(clock)
            if last is not None:
                energy_j += _energy_between(meter, last, sample)
        except MeterError as error:
            skipped, failed_in_a_row = skipped + 1, failed_in_a_row + 1
            if failed_in_a_row == _GONE_AFTER:
                raise MeterError(f"{meter.title} failed {_GONE_AFTER} times in a row; the last time: {error}") from None
            continue
        first, last = first or sample, sample
        readings, failed_in_a_row = readings + 1, 0
    if readings < 2 or skipped > readings or last.t_mono_s <= first.t_mono_s:
        raise MeterError(
            f"{meter.title} gave {readings} usable readings in {window_s:g} s and failed {skipped} times: measure for "
            "longer, or check its wiring."
        )
    covered_s = last.t_mono_s - first.t_mono_s
    return MeanPower(energy_j / covered_s, covered_s, readings, skipped)


def _energy_between(meter: Meter, earlier: PowerSample, later: PowerSample) -> float:
    """Return the joules between two readings. Raises MeterError for counters that have moved by more than any machine
    draws: a counter that was reset looks like one that has wrapped."""
    step_s = later.t_mono_s - earlier.t_mono_s
    if not meter.wraps_j:
        return (earlier.power_w + later.power_w) / 2 * step_s
    pairs = zip(earlier.energies_j, later.energies_j, meter.wraps_j, strict=True)
    step_j = sum((after - before) % wrap for before, after, wrap in pairs)
    if step_j > ABSURD_W * step_s:
        raise MeterError(f"its counter moved by {step_j:g} J in {step_s:.3g} s, which cannot be.")
    return step_j
