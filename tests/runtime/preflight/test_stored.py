"""Figures that are kept: written as a whole, used on the same machine only; and the profile beside them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from edgevpr.core.errors import UsageError
from edgevpr.core.types import StageCost
from edgevpr.power import calibrate
from edgevpr.power.boards import MachineSpeed, load_board, own_profile
from edgevpr.power.calibrate import Meter, MeterError
from edgevpr.runtime.preflight import stored as measured
from edgevpr.runtime.preflight import trial
from edgevpr.runtime.preflight.probe import TechniqueCosts
from edgevpr.runtime.preflight.stored import (
    default_path,
    gathered,
    load,
    measured_profile,
    require_room,
    save,
    write_profile,
)
from edgevpr.runtime.preflight.trial import Trial

COSTS = TechniqueCosts(
    encode=StageCost(0.1, 0.2),
    match_per_place=StageCost(0.004, 0.005),
    ram_bytes_per_place=90,
    disk_bytes_per_place=31_776,
    process_mb=88.5,
    candidates=40,
    scan_per_place=StageCost(2e-6, 3e-6),
)
SCORE = MachineSpeed(single=0.2, multi=0.7, products=0.1, passes=0.4, verified=True, source="edgevpr's micro-benchmark")
COHOG = Trial(label="cohog", name="cohog", settings={}, costs=COSTS, parameters={"w1": 512, "gt": 0.4})
HOG = Trial(label="hog 1bit", name="hog", settings={"form": "1bit"}, costs=replace(COSTS, candidates=None))
CALC = Trial(label="calc", name="calc", settings={}, problem="There is no model `calc`.")


@pytest.fixture
def kept(tmp_path):
    path = tmp_path / "measured.json"
    save(gathered([COHOG, HOG, CALC], 2, SCORE), path)
    return path


def changed(path, **changes):
    fields = json.loads(path.read_text())
    fields["identity"].update(changes)
    path.write_text(json.dumps(fields))
    return load(path)


def test_figures_of_this_machine_are_read_back_as_they_were(kept):
    found, refused = load(kept)
    assert refused is None
    assert found.trials == (COHOG, HOG, CALC)
    assert (found.score, found.threads) == (SCORE, 2)
    assert [path.name for path in kept.parent.iterdir()] == ["measured.json"]
    assert found.identity["numpy"] == np.__version__


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"machine": "Raspberry Pi 5"}, "machine: Raspberry Pi 5 there, "),
        ({"kernel": "2.6.32"}, "kernel: 2.6.32 there, "),
        ({"onnxruntime": None}, "onnxruntime: None there, "),
    ],
)
def test_figures_of_another_machine_or_installation_are_refused_and_it_is_said(kept, changes, said):
    found, refused = changed(kept, **changes)
    assert found is None
    assert f"({said}" in refused
    assert "--measure" in refused


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[]", "null", '{"format": 4}', '{"format": 4, "trials": 3}', '{"score": {}}'),
        lambda text: text.replace('"wall_s": 0.1', '"wall_s": "quick"'),
        lambda text: text.replace('"scan_once"', '"scanned"'),
        lambda text: text.replace('"single": 0.2', '"single": 0'),
    ],
)
def test_figures_that_cannot_be_read_are_said_and_not_used(kept, text):
    kept.write_text(text if isinstance(text, str) else text(kept.read_text()))
    figures, refused = load(kept)
    assert figures is None
    assert refused.startswith(f"{kept} holds no figures ")


def test_another_version_of_the_file_is_said_and_no_file_is_nothing_to_say(kept):
    kept.write_text('{"format": 2}')
    assert "another version" in load(kept)[1]
    assert load(kept.with_name("none.json")) == (None, None)


def test_settings_that_are_the_defaults_are_the_same_and_others_are_not(kept):
    stored, _ = load(kept)
    assert stored.of(Trial(label="cohog", name="cohog", settings={"gt": 0.4})) == replace(COHOG, measured=True)
    assert stored.of(Trial(label="calc", name="calc", settings={})) is None, (
        "what could not be used then is tried again"
    )
    assert stored.of(Trial(label="cohog", name="cohog", settings={"gt": 0.7})) is None


def test_figures_of_another_network_are_not_used(kept, monkeypatch):
    fingerprints = {"calc": "old"}
    monkeypatch.setattr(trial, "load_card", lambda name: type("Card", (), {"fingerprint": fingerprints[name]}))
    path = kept
    save(gathered([Trial(label="calc", name="calc", settings={}, costs=COSTS, model="old")], 1, SCORE), path)
    stored, _ = load(path)
    assert stored.of(Trial(label="calc", name="calc", settings={})) is not None
    fingerprints["calc"] = "new"
    assert stored.of(Trial(label="calc", name="calc", settings={})) is None


def test_a_file_is_replaced_as_a_whole_or_stays_as_it_was(kept, monkeypatch):
    before = kept.read_bytes()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(measured.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save(gathered([COHOG], 1, SCORE), kept)
    assert kept.read_bytes() == before
    assert [path.name for path in kept.parent.iterdir()] == [kept.name]


def test_where_nothing_can_be_written_is_said_before_the_work(tmp_path, monkeypatch):
    for name in ("no/m.json", "valley.gpkg"):
        with pytest.raises(UsageError, match=name):
            require_room(tmp_path / name)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    require_room(default_path())
    assert default_path() == tmp_path / "data/edgevpr/measured.json"
    assert default_path().parent.is_dir()
    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    with pytest.raises(UsageError, match="no such folder"):
        require_room(default_path())


def test_the_score_that_is_scaled_from_is_measured_unless_both_are_published(monkeypatch, kept):
    monkeypatch.setattr(measured, "micro_benchmark", lambda: SCORE)
    x86, pi, other = load_board("generic-x86"), load_board("rpi-4b"), load_board("rpi-5")
    stored, _ = load(kept)
    assert measured.scaled_from(x86, pi, None).benchmark_score == SCORE
    assert (
        measured.scaled_from(x86, pi, replace(stored, score=pi.benchmark_score)).benchmark_score == pi.benchmark_score
    )
    assert measured.scaled_from(pi, other, stored) == pi, "7-zip beside 7-zip"
    measured_there = replace(other, benchmark_score=SCORE)
    assert measured.scaled_from(pi, measured_there, stored).benchmark_score == SCORE
    assert measured.scaled_from(x86, x86, None) == x86


def meter_at(held, watts, title="INA3221 (hwmon1), channel VDD_IN", certain=True):
    return Meter(title=title, look=lambda: watts(held[-1]), certain=certain)


@pytest.fixture
def held(monkeypatch):
    """A machine that holds any load at once; the loads that were held."""
    held = []

    def measure_at(meter, share):
        held.append(share)
        return share, meter.read_w()

    monkeypatch.setattr(calibrate, "measure_at", measure_at)
    return held


def test_the_watts_of_a_meter_are_fitted_and_written_into_a_profile_that_names_it(monkeypatch, tmp_path, held, capsys):
    meter = meter_at(held, lambda share: 2.0 + 4.5 * share)
    monkeypatch.setattr(calibrate, "find_meters", lambda: (meter,))
    path, said = measured_profile(tmp_path / "measured.json", SCORE)
    board = load_board(str(path))
    assert (board.idle_w, board.full_w, board.verified) == (pytest.approx(2.0), pytest.approx(6.5), True)
    assert meter.title in board.source
    assert board.benchmark_score == SCORE
    assert path.parent == tmp_path
    assert path.name.startswith("measured-")
    assert said.startswith("Power: 2 W idle, 6.5 W ")
    assert "load 100%" in capsys.readouterr().err


def test_without_a_meter_it_is_one_line_and_no_file(monkeypatch, tmp_path):
    monkeypatch.setattr(calibrate, "find_meters", tuple)
    assert measured_profile(tmp_path / "m.json", SCORE) == (None, calibrate.NO_METER)
    assert not list(tmp_path.iterdir())


def test_a_meter_that_says_nonsense_leaves_no_file(monkeypatch, tmp_path, held):
    monkeypatch.setattr(calibrate, "find_meters", lambda: (meter_at(held, lambda share: float("nan")),))
    with pytest.raises(MeterError, match="nan W"):
        measured_profile(tmp_path / "m.json", SCORE)
    assert not list(tmp_path.iterdir())


def test_a_file_is_never_overwritten(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("precious")
    for named in (path, tmp_path / "mine.json", tmp_path / "no" / "mine.yaml"):
        with pytest.raises(UsageError, match=str(named)):
            write_profile(named, own_profile(SCORE))
    assert path.read_text() == "precious"
    assert [each.name for each in tmp_path.iterdir()] == ["mine.yaml"]
