"""`make thesis`: its arithmetic is that of the thesis."""

import math

import pytest
import thesis_values


def test_printed_digits_bound_what_they_were_rounded_from():
    value, least, most = thesis_values.corners(lambda a, b: a * b, ["0.50", "20"])
    assert (value, least, most) == pytest.approx((10, 0.495 * 19.5, 0.505 * 20.5))


def test_pcu_of_a_table_row_is_that_of_its_printed_numbers():
    assert thesis_values.printed_pcu("CoHOG")[0] == pytest.approx(0.84 * math.log10(0.83 / 0.02 + 9))
    assert thesis_values.printed_pcu("AMOSNet")[2] is None  # it was trained on that set
    assert thesis_values.printed_pcu("Cross-Region-BoW")[1] == pytest.approx(0.81)  # the slowest: its precision
