"""`edgevpr calibrate-camera`, from a folder of pictures to a lens that a flight reads."""

import json

import pytest
from distorted_cameras import wide

from edgevpr.cli.main import main
from edgevpr.frames.images import write_png
from edgevpr.frames.lens import read_lens


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    folder = tmp_path_factory.mktemp("board")
    for number, image in enumerate(wide().photographs_of_board(25)):
        write_png(folder / f"{number}.png", image)
    return folder


@pytest.mark.slow
def test_calibrate_camera_makes_a_lens_of_a_folder(board, tmp_path, capsys):
    out = str(tmp_path / "lens.yaml")
    assert main(["calibrate-camera", str(board), "--board", "9x6", "--out", out]) == 0
    assert "degrees across" in capsys.readouterr().out
    write_png(board / "99.png", wide().photograph_board((0, 0, 0), (0, 0, 9))[:240])
    assert main(["calibrate-camera", str(board), "--board", "9x6", "--out", out, "--json"]) == 1
    printed = capsys.readouterr()
    assert "99.png has 640x240 pixels" in printed.err
    result = json.loads(printed.out)
    assert result["lens"]["focal_px"] == pytest.approx(read_lens(out).focal_px)
    assert result["views"] <= result["pictures"] == 25


@pytest.mark.parametrize("words", [["--board", "9"], ["--board", "2x6"], ["--board", "9x6", "--seconds", "0"]])
def test_calibrate_camera_refuses_a_wrong_board(board, tmp_path, words):
    with pytest.raises(SystemExit):
        main(["calibrate-camera", str(board), "--out", str(tmp_path / "lens.yaml"), *words])
