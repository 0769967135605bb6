"""Power model of chapter 5 of the thesis, and the resulting charge drawn from the battery pack. Plain arithmetic.

Symbols of the thesis: U, utilisation of the whole machine (0..1); a, idle power; s, power added at full load; P,
power; t, time; indices e, m and q for encoding, matching and a whole query. Equation 5.3, P_q = P_e + P_m, is omitted:
encoding and matching run one after the other, so their powers do not add up. Their energies do, as in equation 5.6."""

import re
from dataclasses import dataclass

from edgevpr.core.errors import ConfigError

_CELL_V = 3.7  # nominal voltage of a lithium-polymer cell
_S_PER_H = 3600.0


@dataclass(frozen=True, slots=True)
class Pack:
    """A battery pack: number of `cells` in series, and capacity."""

    cells: int
    capacity_mah: int

    @property
    def nominal_v(self) -> float:
        return self.cells * _CELL_V


def parse_pack(text: str) -> Pack:
    """Parse a pack such as "4S5200": four cells in series, 5200 mAh. Raises ConfigError for any other text."""
    match = re.fullmatch(r"([0-9]{1,2})S([0-9]{1,6})", text.strip(), re.IGNORECASE)
    if match:
        pack = Pack(int(match[1]), int(match[2]))
        if 1 <= pack.cells <= 24 and pack.capacity_mah >= 1:
            return pack
    raise ConfigError(
        f"The battery pack is `{text}`, but must be the number of cells in series (1 to 24), S and the capacity in mAh "
        "(1 to 999999), such as 4S5200."
    )


def stage_energy_j(idle_w: float, full_w: float, utilisation: float, t_s: float) -> float:
    """Return the energy in joules at the board's input during a stage of `t_s` seconds at `utilisation` (0..1): one
    term of equation 5.6, before the division by the voltage. The power is P = P_i + (P_b - P_i) U (5.1), where P_i is
    `idle_w` and P_b is `full_w`. 5.2 writes it as a + s U; 5.4 applies it to encoding (P_e) and 5.5 to matching (P_m).
    """
    return (idle_w + (full_w - idle_w) * utilisation) * t_s


def marginal_energy_j(idle_w: float, full_w: float, utilisation: float, t_s: float) -> float:
    """Return the energy in joules that a stage of `t_s` seconds adds to the energy of the idle board: s U t."""
    return (full_w - idle_w) * utilisation * t_s


def pack_ah(energy_j: float, pack: Pack, regulator_efficiency: float) -> float:
    """Return the ampere-hours drawn from the pack, by equation 5.6 with the pack's voltage: Ah = P t / (V_pack x
    regulator efficiency). The thesis uses the CPU's 2.5 V rail instead. The efficiency is from 0 to 1."""
    return energy_j / (pack.nominal_v * regulator_efficiency * _S_PER_H)


def queries_ah(queries: float, query_ah: float) -> float:
    """Return the ampere-hours used by `queries` queries of `query_ah` each: Ah_t = N Ah_q (5.7)."""
    return queries * query_ah
