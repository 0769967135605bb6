"""Evaluation and match of pictures that say nothing."""

import cv2
import numpy as np
import pytest
from pictures import textured

from edgevpr.cli.main import main
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import evaluate


@pytest.fixture
def folder(tmp_path):
    """Three places, and four queries: the places darker, and a screen without a signal."""
    screen = np.zeros((120, 160), np.uint8)
    cv2.putText(screen, "NO SIGNAL", (20, 60), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2)
    for split in ("query", "ref"):
        (tmp_path / split).mkdir()
    lines = ["query_file,ref_files", "3.png,2.png"]
    for place in range(3):
        cv2.imwrite(str(tmp_path / "ref" / f"{place}.png"), textured(place))
        cv2.imwrite(str(tmp_path / "query" / f"{place}.png"), textured(place) // 2)
        lines.append(f"{place}.png,{place}.png")
    cv2.imwrite(str(tmp_path / "query" / "3.png"), screen)
    (tmp_path / "truth.csv").write_text("\n".join(lines))
    return tmp_path


def test_a_query_that_says_nothing_finds_nothing_in_an_evaluation(folder):
    dataset = load_dataset(folder / "query", folder / "ref", folder / "truth.csv")
    result = evaluate("cohog", dataset, {"w1": 208})
    assert (result.queries, result.recall_at_10, result.accepted, result.accepted_wrong) == (4, 0.75, 3, 0)


def test_match_says_which_picture_says_nothing(folder, capsys):
    built = ["map", "build", str(folder / "m.gpkg"), "--images", str(folder / "ref"), "--technique", "cohog"]
    assert main([*built, "--param", "w1=208"]) == 0
    assert main(["match", str(folder / "m.gpkg"), "--images", str(folder / "query")]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("3.png")]
    assert "says nothing" in line
    assert " no " in line
