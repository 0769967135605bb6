"""The picture of precision-recall curves: drawn, and refused before the work rather than after it."""

import struct
from dataclasses import replace

import pytest

from edgevpr.core.errors import UsageError
from edgevpr.core.text import require_picture
from edgevpr.lab.evaluate.evaluate import TechniqueResult
from edgevpr.lab.evaluate.tables import plot

pytest.importorskip("matplotlib", reason="pictures need the extra `plots`")

_RESULT = TechniqueResult(
    technique="cohog",
    parameters={},
    queries=4,
    references=4,
    recall_at_1=0.75,
    recall_at_5=1,
    recall_at_10=1,
    precision_at_100_recall=0.75,
    recall_at_100_precision=0.5,
    auc=0.6,
    ep=0.7,
    roc_auc=0.9,
    accepted=1,
    accepted_wrong=0,
    accepted_elsewhere=0,
    t_encode_s=0.01,
    t_match_s=0.01,
    t_match_per_ref_s=0.001,
    descriptor_bytes=64,
    fine_bytes=0,
    u_encode=0.1,
    u_match=0.1,
    ah_total=1e-3,
    ah_total_cpu_rail=1e-3,
    ah_assumes="one watt",
    precision_recall=((1.0, 0.33), (1.0, 0.66), (0.66, 0.66), (0.75, 1.0)),
)


def test_a_panel_a_set_and_also_a_curve_of_one_point_is_drawn(tmp_path):
    one_point = replace(_RESULT, technique="hog", auc=0.0, precision_recall=((1.0, 1.0),))
    plot({"valley": [_RESULT, one_point], "dune": [_RESULT]}, tmp_path / "curves.png")
    header = (tmp_path / "curves.png").read_bytes()[:24]
    assert header.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", header[16:])
    assert width > 1.5 * height, "two sets stand side by side"


@pytest.mark.slow
def test_every_technique_has_a_curve_of_its_own(tmp_path):
    many = [replace(_RESULT, technique=f"technique{number}") for number in range(15)]
    plot({"valley": many}, tmp_path / "curves.svg")
    drawn = (tmp_path / "curves.svg").read_text()
    assert all(f"technique{number} 0.60" in drawn for number in range(15))


@pytest.mark.parametrize(("name", "said"), [("curves.txt", "ends in .png"), ("not/there.png", "no such folder")])
def test_a_picture_that_cannot_be_written_is_refused_before_the_work(tmp_path, name, said):
    with pytest.raises(UsageError, match=said):
        require_picture(tmp_path / name)
