"""`make thesis`: the sweeps are of the technique that flies."""

import math

import numpy as np
import pytest
import thesis_memorable
import thesis_sweep
import thesis_values
from pictures import textured

from edgevpr.techniques import create


@pytest.mark.parametrize(
    ("entropy", "gt", "score", "matching"),
    [
        ("filled_bins", 0.5, thesis_sweep.THESIS, "thesis"),
        ("shannon", 0.4, thesis_sweep.VOTE, "displacement"),
    ],
)
def test_a_point_of_the_sweep_is_the_score_of_cohog(entropy, gt, score, matching):
    query, *places = (textured(seed) for seed in (1, 1, 2, 3))
    query = np.roll(query, 24, axis=1)
    technique = create("cohog", {"matching": matching, "entropy": entropy, "gt": gt})
    asked = technique.encode(query)
    expected = [technique.match(asked, technique.encode(place).fine).score for place in places]

    regions = [thesis_sweep.regions_of(each, thesis_sweep.W1, thesis_sweep.W2) for each in (query, *places)]
    compared = thesis_sweep.compared_of(regions[0], regions[1:])
    chosen = thesis_sweep.at_least(entropy, gt).of(compared)
    assert chosen.tolist() == np.flatnonzero(asked.good).tolist()
    found = thesis_sweep.scores_of(compared, chosen)[score]
    assert found == pytest.approx(expected, abs=0.01)  # a place of the map has 8 bits a number
    assert found.argmax() == 0


def test_the_best_regions_are_those_of_most_entropy():
    entropy = np.array([0.1, 0.9, 0.5, 0.7], np.float32)
    compared = thesis_sweep.Compared(np.zeros((1, 4)), np.zeros((1, 4), int), {"filled_bins": entropy})
    assert thesis_sweep.best_of(2).of(compared).tolist() == [1, 3]
    assert thesis_sweep.scores_of(compared, np.array([], int))[thesis_sweep.THESIS].tolist() == [0]


def test_printed_digits_bound_what_they_were_rounded_from():
    value, least, most = thesis_values.corners(lambda a, b: a * b, ["0.50", "20"])
    assert (value, least, most) == pytest.approx((10, 0.495 * 19.5, 0.505 * 20.5))


def test_pcu_of_a_table_row_is_that_of_its_printed_numbers():
    assert thesis_values.printed_pcu("CoHOG")[0] == pytest.approx(0.84 * math.log10(0.83 / 0.02 + 9))
    assert thesis_values.printed_pcu("AMOSNet")[2] is None  # it was trained on that set
    assert thesis_values.printed_pcu("Cross-Region-BoW")[1] == pytest.approx(0.81)  # the slowest: its precision


def test_queries_that_do_not_pass_are_true_negatives():
    scores, right = np.array([0.9, 0.8, 0.7, 0.6]), np.array([True, False, True, True])
    every = thesis_memorable.auc_of(scores, right, np.ones(4, bool))
    without_the_wrong = thesis_memorable.auc_of(scores, right, right)
    assert every == pytest.approx(((1 + 0.5) / 2 * 0) + (0.5 + 2 / 3) / 2 / 3 + (2 / 3 + 3 / 4) / 2 / 3)
    assert without_the_wrong == pytest.approx(2 / 3)
    assert thesis_memorable.auc_of(scores, right, np.array([True, False, False, False])) is None


def test_a_number_has_three_digits_and_no_exponent():
    assert [thesis_values.three(each) for each in (None, 0.12345, 12.345, 1234.5, 159_999)] == [
        "-", "0.123", "12.3", "1,230", "160,000",
    ]  # fmt: skip
