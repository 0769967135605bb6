"""The power model of chapter 5 of the thesis, and what it means for the battery pack. Plain arithmetic.

Equation 5.3 of the thesis, P_q = P_e + P_m, is left out: encoding and matching follow one another, and powers at
different times do not add. Their energies do, as 5.6 says.
"""

import re
from dataclasses import dataclass

from edgevpr.core.errors import ConfigError

CPU_RAIL_V = 2.5  # the thesis's V: it counts the charge drawn from the CPU's rail
_CELL_V = 3.7  # nominal voltage of a lithium-polymer cell
_S_PER_H = 3600.0


@dataclass(frozen=True, slots=True)
class Pack:
    """A battery pack: `cells` in series, and its capacity."""

    cells: int
    capacity_mah: int

    @property
    def nominal_v(self) -> float:
        return self.cells * _CELL_V


def parse_pack(text: str) -> Pack:
    """Read "4S5200": four cells in series, 5200 mAh. Raises ConfigError for anything else."""
    found = re.fullmatch(r"([0-9]{1,2})S([0-9]{1,6})", text.strip(), re.IGNORECASE)
    if found:
        pack = Pack(int(found[1]), int(found[2]))
        if 1 <= pack.cells <= 24 and pack.capacity_mah >= 1:
            return pack
    raise ConfigError(
        f"The battery pack `{text}` cannot be read: write its cells in series (1 to 24), S and its capacity in mAh "
        "(1 to 999999), as in 4S5200."
    )


def power_w(idle_w: float, full_w: float, utilisation: float) -> float:
    """Return the power at a utilisation of 0..1 of the whole machine: P = P_i + (P_b - P_i) U (5.1), or a + s U (5.2).

    With U_e it is the power of encoding, P_e (5.4); with U_m that of matching, P_m (5.5).
    """
    return idle_w + (full_w - idle_w) * utilisation


def stage_energy_j(idle_w: float, full_w: float, utilisation: float, t_s: float) -> float:
    """Return the energy at the board's input during a stage of `t_s` seconds: (a + s U) t, one term of 5.6 before it is
    divided by the voltage."""
    return power_w(idle_w, full_w, utilisation) * t_s


def marginal_energy_j(idle_w: float, full_w: float, utilisation: float, t_s: float) -> float:
    """Return the energy that the stage adds to a board that is powered anyway: s U t."""
    return (full_w - idle_w) * utilisation * t_s


def rail_ah(energy_j: float, rail_v: float = CPU_RAIL_V) -> float:
    """Return the thesis's form of 5.6, Ah_q = (P_e t_e + P_m t_m) / V with times in hours: ampere-hours of the CPU's
    rail."""
    return energy_j / (rail_v * _S_PER_H)


def pack_ah(energy_j: float, pack: Pack, regulator_efficiency: float) -> float:
    """Return 5.6 as the battery sees it: ampere-hours drawn from the pack, Ah = P t / (V_pack x regulator
    efficiency)."""
    return energy_j / (pack.nominal_v * regulator_efficiency * _S_PER_H)


def endurance_min(pack: Pack, load_w: float) -> float:
    """Return the minutes that a full pack lasts at `load_w` watts drawn from it."""
    return 60 * pack.nominal_v * pack.capacity_mah / 1000 / load_w


def queries_ah(queries: float, query_ah: float) -> float:
    """Return the ampere-hours of `queries` queries: Ah_t = N Ah_q (5.7)."""
    return queries * query_ah
