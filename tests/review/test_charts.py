"""Parts of pages: charts, what is drawn where, and text of foreign origin."""

import re

import pytest

from edgevpr.review.html import (
    Axis,
    Series,
    chart,
    foreign,
    page,
    table,
)

SHARES = Axis(0.0, 1.0, [(0.0, "0"), (0.5, "half"), (1.0, "1")])


def test_points_of_a_curve_lie_where_the_axis_says():
    drawn = chart("Precision", "", [Series("", "row0", [(0.0, 1.0), (0.5, 0.5), (1.0, 0.0)])], SHARES, top=1.0)
    assert 'class="line row0" d="M0.0 0.0L500.0 50.0L1000.0 100.0"' in drawn
    assert re.findall(r'<span style="left:50.0%">half', drawn)


@pytest.mark.parametrize("said", ["<b>", "a\x1b[0m", "rtsp://me:secret@host/"])
def test_foreign_text_is_only_text(said, tmp_path):
    (tmp_path / "none.css").touch()
    made = page(said, tmp_path / "none.css", [table(["a"], [[said]])]) + foreign(said)
    assert not {"\x1b"} & set(made)
    assert "<b>" not in made
    assert "secret" not in made
