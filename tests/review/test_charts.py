"""Charts: what is drawn where."""

import re

import pytest

from edgevpr.review.html import Series, chart, clock, figure, lanes, nice, times


def paths(drawn, kind):
    return re.findall(rf'<path class="{kind} [a-z]*" d="([^"]*)"', drawn)


@pytest.mark.parametrize(("value", "top"), [(0, 1), (0.0004, 0.0004), (0.97, 1), (1, 1), (7, 8), (101, 120), (9.9, 10)])
def test_an_axis_ends_at_a_number_that_is_easily_read(value, top):
    assert nice(value) == pytest.approx(top)


def test_points_lie_where_their_values_are():
    drawn = chart("RAM", "MB", [Series("", "blue", [(0.0, 0.0), (5.0, 50.0), (10.0, 100.0)])], times(10.0))
    assert paths(drawn, "line") == ["M0.0 100.0L500.0 50.0L1000.0 0.0"]


def test_a_line_is_broken_where_nothing_is_known_for_long():
    points = [(float(t), 1.0) for t in (0, 1, 2, 3, 30, 31)]
    (path,) = paths(chart("RAM", "MB", [Series("", "blue", points)], times(100.0)), "line")
    assert path.count("M") == 2


def test_nothing_known_is_no_chart():
    assert chart("RAM", "MB", [Series("", "blue", [])], times(10.0)) == ""


def test_a_lane_counts_its_marks():
    drawn = lanes([("taken", "green", [1.0, 1.0, 9.0])], 10.0)
    assert paths(drawn, "mark") == ["M100 0v20M900 0v20"]
    assert "<b>3</b>" in drawn


def test_times_and_figures_are_short():
    assert (clock(59.6), clock(3723)) == ("1:00", "1:02:03")
    assert (figure(None), figure(1234.5, "m"), figure(0.04567, "mAh")) == ("–", "1234 m", "0.0457 mAh")
