"""A picture of which a network makes nothing is lost, and the flight goes on."""

import cv2
import numpy as np
import pytest
from pictures import textured
from tiny_networks import CARD, write_network

from edgevpr.cli.main import main
from edgevpr.core.config import load_config
from edgevpr.runtime.flight.flight import fly
from edgevpr.runtime.flight.flightlog import read_log


@pytest.fixture
def flight(tmp_path, monkeypatch):
    """A map of four places, and three frames over them of which the second is black: all zeros after this network."""
    monkeypatch.setenv("EDGEVPR_MODELS", str(tmp_path / "models"))
    write_network(tmp_path / "models", fault="no bias", card={"input": {**CARD["input"], "mean": [0.0]}})
    for folder, pictures in (
        ("ref", [textured(number) for number in range(4)]),
        ("query", [textured(0), np.zeros((120, 160), np.uint8), textured(1)]),
    ):
        (tmp_path / folder).mkdir()
        for number, picture in enumerate(pictures):
            cv2.imwrite(str(tmp_path / folder / f"{number}.png"), picture)
    flags = ["--images", str(tmp_path / "ref"), "--technique", "tiny"]
    assert main(["map", "build", str(tmp_path / "m.gpkg"), *flags]) == 0
    return tmp_path


def test_a_black_picture_is_named_in_the_log_and_the_next_is_recognised(flight):
    settings = {"map": str(flight / "m.gpkg"), "source.uri": str(flight / "query"), "source.rate_hz": 60.0}
    assert fly(load_config(None, {**settings, "log.path": str(flight / "log")})) == 1
    lines = list(read_log(flight / "log"))
    assert [line["query"] for line in lines if line["kind"] == "query"] == ["0.png", "2.png"]
    (lost,) = [line for line in lines if line["kind"] == "unusable"]
    assert "zeros" in lost["problem"]
