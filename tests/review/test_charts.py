"""Parts of pages: charts, what is drawn where, and text of foreign origin."""

import re

import pytest

from edgevpr.review.html import (
    Axis,
    Series,
    chart,
    clock,
    figure,
    foreign,
    lanes,
    nice,
    page,
    section,
    table,
    times,
)


def paths(drawn, kind):
    return re.findall(rf'<path class="{kind} [a-z]*" d="([^"]*)"', drawn)


@pytest.mark.parametrize(("value", "top"), [(0, 1), (0.0004, 0.0004), (0.97, 1), (1, 1), (7, 8), (101, 120), (9.9, 10)])
def test_an_axis_ends_at_a_number_that_is_easily_read(value, top):
    assert nice(value) == pytest.approx(top)


def test_points_lie_where_their_values_are():
    drawn = chart("RAM", "MB", [Series("", "blue", [(0.0, 0.0), (5.0, 50.0), (10.0, 100.0)])], times(10.0))
    assert paths(drawn, "line") == ["M0.0 100.0L500.0 50.0L1000.0 0.0"]


def test_nothing_known_is_no_chart():
    assert chart("RAM", "MB", [Series("", "blue", [])], times(10.0)) == ""


def test_a_lane_counts_its_marks():
    drawn = lanes([("taken", "green", [1.0, 1.0, 9.0])], 10.0)
    assert paths(drawn, "mark") == ["M100 0v20M900 0v20"]
    assert "<b>3</b>" in drawn


def test_times_and_figures_are_short():
    assert (clock(59.6), clock(3723)) == ("1:00", "1:02:03")
    assert (figure(None), figure(1234.5, "m"), figure(0.04567, "mAh")) == ("–", "1234 m", "0.0457 mAh")


SHARES = Axis(0.0, 1.0, [(0.0, "0"), (0.5, "half"), (1.0, "1")])


def test_points_of_a_curve_lie_where_the_axis_says():
    drawn = chart("Precision", "", [Series("", "row0", [(0.0, 1.0), (0.5, 0.5), (1.0, 0.0)])], SHARES, top=1.0)
    assert 'class="line row0" d="M0.0 0.0L500.0 50.0L1000.0 100.0"' in drawn
    assert re.findall(r'<span style="left:50.0%">half', drawn)


def test_the_last_text_of_an_axis_stays_on_the_page():
    drawn = chart("Precision", "", [Series("", "row0", [(0.0, 1.0)])], SHARES)
    assert '<span class=last style="left:100.0%">1</span>' in drawn
    assert drawn.count("class=last") == 1


def test_an_axis_may_begin_anywhere():
    axis = Axis(-3.0, 1.0, [])
    assert [axis.across(x) for x in (-3.0, -1.0, 1.0, -9.0, 9.0)] == [0.0, 0.5, 1.0, 0.0, 1.0]
    assert Axis(2.0, 2.0, []).across(2.0) == 0.0


def test_nothing_to_draw_is_nothing():
    assert section("title", "") == ""


@pytest.mark.parametrize("said", ["<b>", "a\x1b[0m", "rtsp://me:secret@host/"])
def test_foreign_text_is_only_text(said, tmp_path):
    (tmp_path / "none.css").touch()
    made = page(said, tmp_path / "none.css", [table(["a"], [[said]])]) + foreign(said)
    assert not {"\x1b"} & set(made)
    assert "<b>" not in made
    assert "secret" not in made
