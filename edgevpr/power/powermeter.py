"""A power meter: one reading of it, and the readings that are refused.

A `Meter` reads one number, or raises MeterError with a sentence: a missing file, a text, a negative or an absurd value
is never passed on as a figure. `measure.py` decides how many failures in a row end a measurement.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from edgevpr.core.errors import EdgevprError

ABSURD_W = 1000.0  # no companion computer draws this: the reading is wrong (the bound of `full_w` in a profile)


class MeterError(EdgevprError):
    """A power meter cannot be read, or gives an impossible value."""


@dataclass(frozen=True, slots=True)
class PowerSample:
    """One reading: `power_w`, or `energies_j` of a meter that counts energy, one value a counter (a CPU package)."""

    t_mono_s: float
    power_w: float | None = None
    energies_j: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Meter:
    """A power meter. `covers` is "board" (its input: what a profile's watts mean), "cpu" (the CPU package alone, the
    rest of the machine draws more) or "rail" (some other part).

    `kind` is "ina", "rapl" or "pmic"; reading more often than every `period_s` seconds makes no sense. The counters of
    a meter with `wraps_j` start again from 0 after so many joules, one number a counter. `certain` is False where the
    title contains an assumption.
    """

    kind: Literal["ina", "rapl", "pmic"]
    title: str
    covers: Literal["board", "cpu", "rail"]
    period_s: float
    look: Callable[[], tuple[float, ...]]
    wraps_j: tuple[float, ...] = ()
    certain: bool = True

    def read(self, clock: Callable[[], float] = time.monotonic) -> PowerSample:
        """Read once, stamped with the middle of the reading. Raises MeterError."""
        before_s = clock()
        values = self.look()
        t_s = (before_s + clock()) / 2
        if self.wraps_j:
            if not all(0 <= value <= wrap for value, wrap in zip(values, self.wraps_j, strict=True)):
                raise MeterError(f"{self.title} counts {values} J, outside its own range: its driver does not work.")
            return PowerSample(t_s, energies_j=values)
        if not 0 <= values[0] < ABSURD_W:
            raise MeterError(f"{self.title} says {values[0]:g} W, which cannot be: check its wiring and its driver.")
        return PowerSample(t_s, power_w=values[0])


def number(path: Path) -> float:
    """Read the number in a file of /sys. Raises MeterError, which says what to do."""
    try:
        text = path.read_text(errors="replace")
    except PermissionError:
        raise MeterError(
            f"{path} can be read by the superuser only: run this with sudo, or allow it with sudo chmod a+r {path}."
        ) from None
    except OSError as error:
        raise MeterError(f"{path} cannot be read ({error.strerror}): the power meter is gone.") from None
    return parsed(text, str(path))


def parsed(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise MeterError(f"{where} says {text.strip()[:40]!r}, which is no number: the power meter does not work.")
    return value
