"""The calibration of a map in flight, with its model of confidence: used if it makes sense, never a reason to stop."""

import json
import logging
import math
import shutil
import zlib
from dataclasses import asdict, replace

import pytest
from pictures import draw_texture
from walks import make_map

from edgevpr.core.config import load_config
from edgevpr.core.types import Frame, Position
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise import calibration
from edgevpr.runtime.recognise.confidence import parse_model, read_default_model
from edgevpr.runtime.recognise.evidence import MAP_FIGURES, PLACE_FIGURES
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.techniques import create

SHIPPED = {kind: read_default_model(kind) for kind in ("ahead", "ahead_proven")}
OWN_MODEL = replace(SHIPPED["ahead"], made_of="this map")
CALIBRATION = calibration.MapCalibration(
    models={"ahead": OWN_MODEL},
    made="2026-05-01",
    asked=120,
    precision=0.999,
    accepted=0.75,
    accepted_wrong=1,
    recognisable={3: 0.2, 7: 0.95, 12: 0.5, 40: 1.0},
)


def frame(number):
    position = Position(50 + 0.001 * number, 8.0)
    return Frame(image=draw_texture(number, 240, 320), name=str(number), t_mono_s=0.0, position=position)


@pytest.fixture(scope="module")
def built_map(tmp_path_factory):
    return make_map(tmp_path_factory.mktemp("map") / "m.gpkg", create("cohog", {"w1": 208}), map(frame, range(3)))


@pytest.fixture
def path(built_map, tmp_path):
    return shutil.copy(built_map, tmp_path / "m.gpkg")


def write_calibration(path, text):
    with PlaceMap.open_for_writing(path) as place_map:
        place_map.record_calibration(text)


def fly_over_map(path):
    """The models by which the flight over a map decides, and whether it recognises its own picture."""
    recogniser = open_recogniser(load_config(None, {"map": str(path)}), load_board("this"), uses_hints=True)
    with recogniser.place_map:
        event = recogniser.step(frame(1))
        assert not event.failed, event.reason
        assert 0 <= event.confidence <= 1
        assert event.best.place.source_image == "1"
        return recogniser.rule.confidence_rule.models


def test_flight_uses_the_calibrated_models_of_its_map(path, caplog):
    assert fly_over_map(path) == SHIPPED
    write_calibration(path, calibration.format_calibration(CALIBRATION))
    assert fly_over_map(path) == {**SHIPPED, "ahead": OWN_MODEL}, "an older edgevpr calibrated one of them"
    with PlaceMap.open(path) as place_map:
        assert calibration.read_calibration_for(place_map) == CALIBRATION
    assert not caplog.records


def change_calibration(more=(), **figures):
    """The text of the calibration with `more` fields or other figures of its model, and its checksum."""
    stored = json.loads(calibration.format_calibration(CALIBRATION)[8:])
    stored["models"]["ahead"].update(more)
    stored["models"]["ahead"]["of_map"].update(figures)
    body = json.dumps(stored)
    return f"{zlib.crc32(body.encode()):08x}{body}"


DAMAGED = {
    "empty": "",
    "no json": "deadbeef{",
    "changed": calibration.format_calibration(CALIBRATION).replace("2026", "2025"),
    "evidence that there is not": change_calibration(names=["colour", *OWN_MODEL.of_map.names[1:]]),
    "a kind that there is not": calibration.format_calibration(replace(CALIBRATION, models={"sideways": OWN_MODEL})),
    "a weight too few": change_calibration(weights=OWN_MODEL.of_map.weights[1:]),
    "a field of another version": change_calibration({"of_other_places": []}),
    "a place that is no number": calibration.format_calibration(replace(CALIBRATION, recognisable={"x": 0.5})),
    "no places": calibration.format_calibration(replace(CALIBRATION, recognisable=None)),
    "a wrong surrogate": "\ud800" * 9,
}


@pytest.mark.parametrize("text", DAMAGED.values(), ids=DAMAGED)
def test_flight_uses_the_default_model_and_reports_a_damaged_calibration(path, text, caplog):
    write_calibration(path, text)
    with caplog.at_level(logging.WARNING):
        assert fly_over_map(path) == SHIPPED
    (record,) = [each for each in caplog.records if "calibration" in each.message]
    assert "map calibrate" in record.message
    assert len(record.message) < 500


@pytest.mark.parametrize("kind", MAP_FIGURES)
def test_default_model_gives_a_probability_for_any_evidence(kind):
    model = read_default_model(kind)
    calibration.require_usable(kind, model)
    assert parse_model(json.loads(json.dumps(asdict(model)))) == model
    evidence = dict.fromkeys(MAP_FIGURES[kind] + PLACE_FIGURES[kind], 0.0)
    for value in (-3.0, -1.0, 0.0, 1.0, 3.0):
        assert 0 <= model.confidence(dict.fromkeys(evidence, value)) <= 1
    for value in (math.nan, math.inf, -math.inf):
        assert model.confidence(evidence | {"agree": value, "coverage": value}) < model.threshold(0.9), "nothing sure"
    needed = [model.threshold(precision) for precision in (0.5, 0.9, 0.99, 0.999, 0.999999)]
    assert needed == sorted(needed)
    assert needed[0] < needed[-1]
