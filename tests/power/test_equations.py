"""The power model against the thesis's table 5.2 and against hand-worked figures; how a pack is read."""

import pytest

from edgevpr.core.errors import ConfigError
from edgevpr.power import equations

# Table 5.2: U_e, U_m, t_e s, t_m s (all 7494 references), Ah_t of 4781 queries; a = 0, s = 1, V = 2.5 V.
TABLE_5_2 = {
    "AlexNet": (0.734, 0.0312, 0.666, 3.222, 0.3128),
    "NetVLAD": (0.656, 0.036, 0.77, 0.0374, 0.2688),
    "AMOSNet": (0.437, 0.03, 0.359, 0.614, 0.0931),
    "HybridNet": (0.437, 0.03, 0.357, 0.584, 0.0921),
    "Cross-Region-BoW": (0.32, 0.1, 0.834, 1199.04, 63.836),
    "R-MAC": (0.5, 0.371, 0.478, 0.254, 0.1768),
    "Region-VLAD": (0.25, 0.031, 0.463, 0.899, 0.0764),
    "CALC": (0.781, 0.0312, 0.027, 0.974, 0.0272),
}


RAIL_V = 2.5  # of the CPU, from which the thesis counts the charge


def compute_thesis_ah(u_encode, u_match, t_encode_s, t_match_s):
    energy_j = equations.stage_energy_j(0, 1, u_encode, t_encode_s) + equations.stage_energy_j(0, 1, u_match, t_match_s)
    return equations.queries_ah(4781, energy_j / (3600 * RAIL_V))


@pytest.mark.parametrize("technique", TABLE_5_2)
def test_queries_ah_gives_table_5_2_as_its_printed_digits_allow(technique):
    *inputs, expected_ah = TABLE_5_2[technique]
    within = 0.0054 if technique == "CALC" else 0.005  # its t_e is printed with two digits
    assert compute_thesis_ah(*inputs) == pytest.approx(expected_ah, rel=within)


def test_stage_energy_is_idle_energy_plus_marginal_energy():
    assert equations.stage_energy_j(2.29, 6.82, 0, 1) == 2.29
    assert equations.stage_energy_j(2.29, 6.82, 1, 1) == pytest.approx(6.82, abs=1e-12)
    assert equations.stage_energy_j(2.0, 6.0, 0.25, 10) == 30.0
    assert equations.marginal_energy_j(2.0, 6.0, 0.25, 10) == 10.0


def test_pack_ah_counts_the_regulator():
    # 36 kJ are 10 Wh: 10 / 14.8 / 0.8 Ah from four cells behind a regulator of 80 %.
    assert equations.pack_ah(36_000, equations.Pack(4, 5200), 0.8) == pytest.approx(10 / 14.8 / 0.8, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "cells", "capacity_mah"), [("4S5200", 4, 5200), ("6s16000", 6, 16000), (" 1S450 ", 1, 450)]
)
def test_parse_pack_reads_a_label(text, cells, capacity_mah):
    pack = equations.parse_pack(text)
    assert (pack.cells, pack.capacity_mah) == (cells, capacity_mah)
    assert pack.nominal_v == pytest.approx(3.7 * cells)


@pytest.mark.parametrize("text", ["", "0S5200", "4S0", "4S", "S5200", "4P5200", "-4S5200", "25S100", "4S5200mAh"])
def test_parse_pack_refuses_nonsense_in_one_sentence(text):
    with pytest.raises(ConfigError) as raised:
        equations.parse_pack(text)
    assert all(part in str(raised.value) for part in (f"`{text}`", "(1 to 24)", "(1 to 999999)", "4S5200."))
