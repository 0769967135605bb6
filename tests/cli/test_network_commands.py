"""Networks and forms through the commands: one map for all forms, and what cannot be used stops nothing else."""

import cv2
import pytest
from commands import expect_refusal, run_json
from pictures import draw_texture, write_flight
from tiny_networks import write_network

from edgevpr.cli.main import main
from edgevpr.core.config import FORMS, load_config
from edgevpr.core.errors import ConfigError
from edgevpr.power.boards import load_board
from edgevpr.runtime.preflight.pick import explain_technique
from edgevpr.runtime.recognise.opening import open_recogniser


@pytest.fixture
def flight(tmp_path, models):
    """Six pictures and the same darker as queries, beside a folder of models with one of our own."""
    write_network(models, "tiny")
    for split, darker in (("ref", 1.0), ("query", 0.9)):
        write_flight(tmp_path / split, [cv2.convertScaleAbs(draw_texture(number), alpha=darker) for number in range(6)])
    return tmp_path


def build_map(flight, *flags):
    path = flight / "m.gpkg"
    assert main(["map", "build", str(path), "--images", str(flight / "ref"), *flags]) == 0
    return path


def test_match_uses_one_map_in_all_forms(capsys, flight):
    path = build_map(flight, "--technique", "calc", "--param", "model=tiny")
    content = path.read_bytes()
    for form in FORMS:
        capsys.readouterr()
        found = run_json(capsys, "match", path, "--images", flight / "query", "--form", form)
        assert [each["place"]["image"] for each in found] == [each["query"] for each in found]
    assert path.read_bytes() == content
    assert main(["match", str(path), "--images", str(flight / "query")]) == 0
    assert "A tiny network" in capsys.readouterr().out


def test_open_recogniser_uses_the_form_of_the_configuration(flight):
    path = build_map(flight, "--technique", "calc", "--param", "model=tiny")
    recogniser = open_recogniser(load_config(None, {"map": str(path), "match.form": "1bit"}), load_board("this"))
    assert recogniser.index.rows.shape == (6, 8)
    reason = explain_technique(recogniser, is_named=False)
    assert reason.startswith("technique calc 1bit: ")
    assert "A tiny network" in reason
    recogniser.place_map.close()
    with pytest.raises(ConfigError, match=r"match\.form"):
        load_config(None, {"match.form": 1})


def test_match_refuses_a_map_of_other_weights(models, flight, capsys):
    path = build_map(flight, "--technique", "calc", "--param", "model=tiny")
    write_network(models, "tiny", fault="dynamic batch")
    capsys.readouterr()
    assert "sha256" in expect_refusal(capsys, "match", path, "--images", flight / "query", code=1)


def test_match_explains_how_to_get_the_network_of_a_map(models, flight, capsys):
    path = build_map(flight, "--technique", "tiny")
    (models / "tiny.yaml").unlink()
    assert main(["match", str(path), "--images", str(flight / "query")]) == 1
    said = capsys.readouterr().err
    assert "EDGEVPR_MODELS" in said
    assert "`tiny`" in said
