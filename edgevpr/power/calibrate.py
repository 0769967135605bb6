"""The two constants of a board's power, a and s of equation 5.2, from its own power meter.

The machine is held at several loads; the straight line P = a + s U through (U, W) is the board's profile.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.power import busy
from edgevpr.power.mean_power import mean_power
from edgevpr.power.powermeter import Meter, MeterError

LOADS = (0.0, 0.25, 0.5, 0.75, 1.0)
_LEAST_LOADS = 3  # any two loads lie on a line: the third shows whether power follows one
_APART = 0.05  # utilisations nearer than this are one load
_LEAST_R2 = 0.5  # below it, most changes of the power do not follow the load


@dataclass(frozen=True, slots=True, kw_only=True)
class PowerFit:
    """Straight line P = `idle_w` + `span_w` U (a and s), with the root mean square of its residuals in watts, and R2;
    `samples` are its points (U, W)."""

    idle_w: float
    span_w: float
    residual_w: float
    r2: float
    samples: tuple[tuple[float, float], ...]

    @property
    def full_w(self) -> float:
        """Watts with every core busy, as a profile wants them."""
        return self.idle_w + self.span_w


@dataclass(frozen=True, slots=True)
class Calibration:
    """A fit and the meter it came from; `skipped` counts the readings that failed."""

    fit: PowerFit
    meter: Meter
    skipped: int

    @property
    def verified(self) -> bool:
        """True for watts at the board's input from a meter whose wiring is known. The CPU package alone is less than
        the board draws, and the wiring of some meters can only be assumed."""
        return self.meter.covers == "board" and self.meter.certain

    @property
    def source(self) -> str:
        """Text of `source` in a profile with these figures."""
        doubt = "" if self.meter.covers == "board" else "CPU only, the rest of the board draws more; "
        return (
            f"{doubt}straight line through {len(self.fit.samples)} loads measured on this machine with its "
            f"{self.meter.title}; residual {self.fit.residual_w:.2g} W, R2 {self.fit.r2:.3f}"
        )


def calibrate(
    meter: Meter,
    loads: Sequence[float] = LOADS,
    window_s: float = 20.0,
    settle_s: float = 5.0,
    root: Path = Path("/"),
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    load: Callable[[float], AbstractContextManager] = busy.load,
    progress: Callable[[float], None] = lambda share: None,
) -> Calibration:
    """Hold each load for `settle_s` + `window_s` seconds and fit a line. Raises MeterError for a meter that fails and
    for figures that no board can have.

    U is the utilisation of the whole machine, other programs included, since the meter measures them too. `progress` is
    called with each load before it is held.
    """
    samples, skipped = [], 0
    for share in loads:
        progress(share)
        with load(share):
            sleep(settle_s)
            before = busy.cpu_times(root)
            measured = mean_power(meter, window_s, clock, sleep)
            after = busy.cpu_times(root)
        samples.append((busy.utilisation(before, after), measured.mean_w))
        skipped += measured.skipped
    return Calibration(fit_power(samples), meter, skipped)


def fit_power(samples: Sequence[tuple[float, float]]) -> PowerFit:
    """Fit W = a + s U by least squares to samples (U, W), U in 0..1. Raises MeterError where the result cannot be a
    board's."""
    u, watts = np.array(samples, np.float64).reshape(-1, 2).T
    if not (np.isfinite(u).all() and np.isfinite(watts).all()):
        raise MeterError("A power measurement is not a number: measure again.")
    distinct: list[float] = []
    for each in np.sort(u):
        if not distinct or each - distinct[-1] > _APART:
            distinct.append(each)
    if len(distinct) < _LEAST_LOADS:
        raise MeterError(
            f"Power was measured at {len(distinct)} different loads; a line needs {_LEAST_LOADS}: stop other "
            "programs, and let this one use all cores."
        )
    (idle_w, span_w), *_ = np.linalg.lstsq(np.column_stack([np.ones_like(u), u]), watts, rcond=None)
    if idle_w < -1e-9:
        raise MeterError(
            f"The measured power would be {idle_w:.3g} W at idle, which cannot be: check the meter's wiring, and "
            "measure for longer."
        )
    left = watts - (idle_w + span_w * u)
    spread = float(((watts - watts.mean()) ** 2).sum())
    r2 = 1.0 - float((left**2).sum()) / spread if spread > 0 else 0.0
    if span_w <= 0 or r2 < _LEAST_R2:
        raise MeterError(
            f"The measured power does not follow the load ({span_w:.3g} W from idle to full, R2 {r2:.2f}): see that "
            "the meter is wired to what feeds the CPU, and measure for longer."
        )
    return PowerFit(
        idle_w=max(0.0, float(idle_w)),
        span_w=float(span_w),
        residual_w=float(np.sqrt((left**2).mean())),
        r2=r2,
        samples=tuple((float(a), float(b)) for a, b in samples),
    )
