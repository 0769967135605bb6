"""The hostile pictures asked in the maps of real image sets, in short; and eval and match of pictures that say
nothing."""

import os
from pathlib import Path

import cv2
import hostile_pictures
import numpy as np
import pytest
from pictures import textured

from edgevpr.cli.main import main
from edgevpr.core.types import Frame
from edgevpr.frames.images import read_image
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.lab.evaluate.evaluate import evaluate

DATA = Path(os.environ.get("EDGEVPR_DATA") or Path(__file__).resolve().parents[4] / "shared" / "data")
# Views ahead that were accepted as places of maps made looking down, when only score and margin were asked.
AHEAD = {
    "aerial_brighton": [f"nordland_tiny/query/{number}.png" for number in ("0216", "0222", "0291", "0324", "0330")]
    + ["grief_stromovka_seasons/query/0055.jpg", "grief_stromovka_seasons/ref/0035.jpg"],
}
needs_sets = pytest.mark.skipif(not DATA.is_dir(), reason="the image sets of ../shared/data are not there")


@needs_sets
@pytest.mark.parametrize("name", AHEAD)
def test_a_map_made_looking_down_knows_that_a_view_ahead_is_none_of_its_places(name, tmp_path):
    recogniser = hostile_pictures.mapped(DATA / name, tmp_path)
    with recogniser.place_map:
        pictures = [Frame(image=read_image(DATA / path), name=path, t_mono_s=0.0) for path in AHEAD[name]]
        events = [recogniser.step(picture) for picture in pictures]
        assert not any(event.accepted for event in events)
        own = next((DATA / name / "query").glob("*.jp*g"), None) or next((DATA / name / "query").glob("*.JP*G"))
        assert recogniser.step(Frame(image=read_image(own), name="own", t_mono_s=0.0)).accepted


@needs_sets
def test_a_run_counts_every_kind_and_nothing_wrong_is_accepted():
    rows = hostile_pictures.run(count=2, seed=31, names=["corridor"])
    kinds = [row.kind for row in rows]
    assert kinds[:2] == ["nothing: no signal: bars", "nothing: no signal: blue"]
    assert "out of focus" in kinds
    assert kinds[-1].startswith("other camera: ")
    assert sum(row.tried for row in rows) == 2 + 11 + 2
    assert {(row.set, row.camera) for row in rows} == {("corridor", "forward")}
    assert sum(row.accepted_wrong for row in rows) == 0
    assert rows == hostile_pictures.run(count=2, seed=31, names=["corridor"])


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
    assert "(the picture says nothing)" in line
    assert " no " in line
