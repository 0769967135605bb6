"""Parts of pages: charts, what is drawn where, and text of foreign origin."""

import re

from edgevpr.review.html import Axis, Series, chart, foreign, page, table

SHARES = Axis(0.0, 1.0, [(0.0, "0"), (0.5, "half"), (1.0, "1")])


def test_points_of_a_curve_lie_where_the_axis_says():
    drawn = chart("Precision", "", [Series("", "row0", [(0.0, 1.0), (0.5, 0.5), (1.0, 0.0)])], SHARES, top=1.0)
    assert 'class="line row0" d="M0.00 0.00L500.00 50.00L1000.00 100.00"' in drawn
    assert re.findall(r'<span style="left:50.0%">half', drawn)


def test_foreign_text_hides_passwords(tmp_path):
    said = "rtsp://me:secret@host/"
    (tmp_path / "none.css").touch()
    assert "secret" not in page(said, tmp_path / "none.css", [table(["a"], [[said]])]) + foreign(said)
