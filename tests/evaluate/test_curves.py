"""The picture of precision-recall curves: drawn, and refused before the work rather than after it."""

import struct
from dataclasses import replace

import pytest

from edgevpr.errors import UsageError
from edgevpr.evaluate.curves import plot
from edgevpr.evaluate.evaluate import TechniqueResult
from edgevpr.helpers.figures import require_picture

pytest.importorskip("matplotlib", reason="pictures need the extra `plots`")

_RESULT = TechniqueResult(
    "cohog", {}, 4, 4, 0.75, 1, 1, 0.75, 0.5, 0.6, 0.7, 0.9, 1, 0, 0.01, 0.01, 0.001, 64, 0, 0.1, 0.1, 1e-3, 1e-3,
    "one watt", ((1.0, 0.33), (1.0, 0.66), (0.66, 0.66), (0.75, 1.0)),
)  # fmt: skip


def test_a_panel_a_set_and_also_a_curve_of_one_point_is_drawn(tmp_path):
    one_point = replace(_RESULT, technique="hog", auc=0.0, precision_recall=((1.0, 1.0),))
    plot({"valley": [_RESULT, one_point], "dune": [_RESULT]}, tmp_path / "curves.png")
    header = (tmp_path / "curves.png").read_bytes()[:24]
    assert header.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", header[16:])
    assert width > 1.5 * height, "two sets stand side by side"


def test_every_technique_has_a_curve_of_its_own(tmp_path):
    many = [replace(_RESULT, technique=f"technique{number}") for number in range(15)]
    plot({"valley": many}, tmp_path / "curves.svg")
    drawn = (tmp_path / "curves.svg").read_text()
    assert all(f"technique{number} 0.60" in drawn for number in range(15))


@pytest.mark.parametrize(("name", "said"), [("curves.txt", "ends in .png"), ("not/there.png", "no such folder")])
def test_a_picture_that_cannot_be_written_is_refused_before_the_work(tmp_path, name, said):
    with pytest.raises(UsageError, match=said):
        require_picture(tmp_path / name)
