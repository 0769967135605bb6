"""The calibration that a map brings into a flight: used where it makes sense, and never a reason to stop."""

import contextlib
import json
import logging
import shutil
import sqlite3
from dataclasses import replace

import pytest
from fakes import FakeClock
from pictures import textured

from edgevpr.core.config import load_config
from edgevpr.core.types import Frame, Position
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.power.equations import Pack
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.confidence import prior
from edgevpr.runtime.recognise.evidence import MapCalibration, calibration_of, calibration_text
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.techniques import create

OWN = replace(prior("ahead"), made_of="this map")
FOUND = MapCalibration(
    models={"ahead": OWN}, made="2026-05-01", asked=9, precision=0.99, accepted=1.0, accepted_wrong=0
)


def frame(number):
    position = Position(50 + 0.001 * number, 8.0)
    return Frame(image=textured(number, 240, 320), name=str(number), t_mono_s=0.0, position=position)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    path, technique, clock = tmp_path_factory.mktemp("map") / "m.gpkg", create("cohog", {"w1": 208}), FakeClock()
    meter = QueryMeter(load_board("rpi-4b"), Pack(4, 5200), 0.85, wall_clock=clock, cpu_clock=clock.clock.process_cpu_s)
    with PlaceMap.create(path, technique.spec) as place_map:
        build_map(map(frame, range(3)), technique, place_map, meter)
    return path


@pytest.fixture
def path(built, tmp_path):
    return shutil.copy(built, tmp_path / "m.gpkg")


def keep(path, text):
    with PlaceMap.open_for_adding(path) as place_map:
        place_map.record_calibration(text)


def flown(path):
    """The models by which the flight over a map decides, and whether it recognises its own picture."""
    recogniser = open_recogniser(load_config(None, {"map": str(path)}), load_board("this"), narrowed=True)
    with recogniser.place_map:
        event = recogniser.step(frame(1))
        assert not event.failed, event.reason
        assert 0 <= event.confidence <= 1
        assert event.best.place.source_image == "1"
        return recogniser.rule.sure.models


def test_a_flight_decides_by_the_models_of_its_map(path, caplog):
    assert flown(path) == {"ahead": prior("ahead")}
    keep(path, calibration_text(FOUND))
    assert flown(path) == {"ahead": OWN}
    with PlaceMap.open(path) as place_map:
        assert calibration_of(place_map) == FOUND
    assert not caplog.records


def renamed(model):
    return replace(model, of_map=replace(model.of_map, names=("colour", *model.of_map.names[1:])))


def too_sure(model):
    return replace(model, of_place=replace(model.of_place, bias=float("nan")))


DAMAGED = {
    "empty": "",
    "no json": "deadbeef{",
    "changed": calibration_text(FOUND).replace("2026", "2025"),
    "evidence that there is not": calibration_text(replace(FOUND, models={"ahead": renamed(OWN)})),
    "a kind that there is not": calibration_text(replace(FOUND, models={"sideways": OWN})),
    "not a number": calibration_text(replace(FOUND, models={"ahead": too_sure(OWN)})),
}


@pytest.mark.parametrize("text", DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_calibration_is_said_and_the_shipped_model_flies(path, text, caplog):
    keep(path, text)
    with caplog.at_level(logging.WARNING):
        assert flown(path) == {"ahead": prior("ahead")}
    (record,) = [each for each in caplog.records if "calibration" in each.message]
    assert "`edgevpr map calibrate` makes it anew" in record.message
    assert len(record.message) < 500


@pytest.mark.parametrize("value", [b"\xff", "7", "[" * 5000, json.dumps(["x"]), b"\xa5" * 90_000_000])
def test_a_row_of_another_form_ends_no_flight(path, value, caplog):
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute("INSERT OR REPLACE INTO edgevpr_map (key, value) VALUES ('calibration', ?)", (value,))
    assert flown(path) == {"ahead": prior("ahead")}
