"""`edgevpr salience`, and maps that keep only what is worth remembering."""

import json

import numpy as np
import pytest
from commands import expect_refusal, run_json

pytest.importorskip("onnx", reason="the test networks are written with onnx (pip install onnx)")

from tiny_detectors import write_detector, write_memorability

from edgevpr.cli.main import main
from edgevpr.frames.images import cv2
from edgevpr.places.mapfile import PlaceMap


@pytest.fixture
def networks(models):
    write_memorability(models)
    write_detector(models, [(0, 0, 32, 64, 2)])
    return models


def draw_texture(seed, spread=40.0):
    fine = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, (120, 160)), (0, 0), 1.5)
    return np.clip(128 + spread * fine / fine.std(), 0, 255).astype(np.uint8)


@pytest.fixture
def recording(tmp_path):
    """Sixty frames; of the thirty in the middle, each is of one colour or nearly so."""
    folder = tmp_path / "recording"
    folder.mkdir()
    for number in range(60):
        cv2.imwrite(str(folder / f"{number:02d}.png"), draw_texture(number, 1.5 if 15 <= number < 45 else 40.0))
    return folder


def write_config(tmp_path, **keys):
    path = tmp_path / "config.yaml"
    path.write_text(json.dumps({"salience": {"network": None, "memorability": 0, "staticity": 0, **keys}}))
    return str(path)


def test_salience_scores_a_picture(networks, tmp_path, capsys):
    picture = tmp_path / "p.png"
    cv2.imwrite(str(picture), draw_texture(1))
    settings = write_config(tmp_path, network="bright", detector="tiny", staticity=0.6)
    command = ["salience", str(picture), "--config", settings]
    assert main(command) == 0
    assert "staticity          0." in capsys.readouterr().out
    said = run_json(capsys, *command)
    assert (said["kept"], said["staticity"]) == (False, pytest.approx(0.5, abs=0.01))
    write_memorability(networks, gain=3.0)
    settings = write_config(tmp_path, memorability=0.3, network="bright")
    assert "0 to 1" in expect_refusal(capsys, "salience", picture, "--config", settings, code=1)


@pytest.mark.slow
def test_map_build_leaves_out_frames_and_limits_gaps(recording, tmp_path, capsys):
    place_map = tmp_path / "m.gpkg"
    command = ["map", "build", str(place_map), "--images", str(recording), "--technique", "hog", "--salience"]
    built = run_json(capsys, *command, "--config", write_config(tmp_path))
    with PlaceMap.open(place_map) as opened:
        places = list(opened.read_places())
    low = [int(place.source_image[:2]) for place in places if place.salience.is_low]
    assert [int(place.source_image[:2]) for place in places if not place.salience.is_low] == [
        *range(15),
        *range(45, 60),
    ]
    assert low
    assert all(15 <= number < 45 for number in low)
    assert max(np.diff([14, *low, 45])) <= 21
    assert built["added"] == len(places)
    assert built["of_low_quality"] == len(low)
    assert built["not_memorable"] == 30 - len(low)
    capsys.readouterr()
    assert main(["map", "info", str(place_map)]) == 0
    assert f"  salience    {len(low)} of " in capsys.readouterr().out
    assert run_json(capsys, "map", "info", place_map)["of_low_quality"] == len(low)


@pytest.mark.slow
def test_match_skips_a_query_that_is_not_memorable(recording, tmp_path, capsys):
    place_map = str(tmp_path / "m.gpkg")
    assert main(["map", "build", place_map, "--images", str(recording), "--technique", "hog"]) == 0
    flags = ["--images", recording, "--salience", "--config", write_config(tmp_path, entropy=0.5)]
    answers = run_json(capsys, "match", place_map, *flags)
    skipped = [each for each in answers if each["reason"]["code"] == "NOT_MEMORABLE"]
    assert [int(each["query"][:2]) for each in skipped] == [*range(15, 45)]
    assert all(each["place"] is None and not each["accepted"] for each in skipped)


@pytest.mark.parametrize(
    ("keys", "code", "complaint"),
    [
        ({"entropy": 0.8}, 2, "0.792"),
        ({"entropy": 0}, 2, "all criteria"),
        ({"memorability": 0.5, "network": "tiny"}, 1, "has no `outputs.memorability`"),
        ({"staticity": 0.5, "detector": "bright"}, 1, "is not a detector"),
    ],
)
def test_salience_refuses_wrong_settings(networks, keys, code, complaint, tmp_path, capsys):
    picture = tmp_path / "p.png"
    cv2.imwrite(str(picture), draw_texture(1))
    settings = write_config(tmp_path, **keys)
    assert complaint in expect_refusal(capsys, "salience", picture, "--config", settings, code=code, is_alone=True)


def test_salience_without_a_network_turns_its_criterion_off(tmp_path, capsys, caplog):
    picture = tmp_path / "p.png"
    cv2.imwrite(str(picture), draw_texture(1))
    assert main(["salience", str(picture), "--config", write_config(tmp_path, memorability=0.5, staticity=0.6)]) == 0
    assert "`salience.network`" in caplog.text
    assert "`salience.detector`" in caplog.text
