"""Figures that are kept: written as a whole, used on the same machine only; and the profile beside them."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from edgevpr.core.errors import EdgevprError, ImageError, SourceError, UsageError
from edgevpr.core.types import StageCost
from edgevpr.power import calibrate, sensors
from edgevpr.power.boards import MachineSpeed, load_board, own_profile
from edgevpr.power.sensors import Meter, MeterError
from edgevpr.runtime.preflight import stored as measured
from edgevpr.runtime.preflight import trial
from edgevpr.runtime.preflight.presentation import format_stored
from edgevpr.runtime.preflight.probe import TechniqueCosts
from edgevpr.runtime.preflight.stored import (
    default_path,
    gathered,
    known_and_tried,
    load,
    measured_profile,
    pictures_of,
    require_new_profile,
    require_room,
    save,
    write_profile,
)
from edgevpr.runtime.preflight.trial import Offer, Trial

COSTS = TechniqueCosts(
    encode=StageCost(0.1, 0.2),
    match_per_place=StageCost(0.004, 0.005),
    ram_bytes_per_place=90,
    disk_bytes_per_place=31_776,
    process_mb=88.5,
    candidates=40,
    scan_per_place=StageCost(2e-6, 3e-6),
    encode_mb=11.0,
)
SCORE = MachineSpeed(single=0.2, multi=0.7, products=0.1, passes=0.4, verified=True, source="edgevpr's micro-benchmark")
COHOG = Trial(label="cohog", name="cohog", settings={}, costs=COSTS, parameters={"w1": 512, "gt": 0.4})
HOG = Trial(
    label="hog 1bit", name="hog", settings={"form": "1bit"}, costs=replace(COSTS, candidates=None, encode_mb=None)
)
CALC = Trial(label="calc", name="calc", settings={}, problem="There is no model `calc`.")


@pytest.fixture
def kept(tmp_path):
    path = tmp_path / "measured.json"
    save(gathered([COHOG, HOG, CALC], "8 generated pictures", 2, SCORE), path)
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
    assert (found.score, found.threads, found.pictures) == (SCORE, 2, "8 generated pictures")
    assert [path.name for path in kept.parent.iterdir()] == ["measured.json"]
    assert {"machine", "cores", "RAM in MB", "kernel", "edgevpr", "numpy", "opencv", "onnxruntime"} <= set(
        found.identity
    )
    assert found.identity["numpy"] == np.__version__


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"machine": "Raspberry Pi 5"}, "machine: Raspberry Pi 5 there, "),
        ({"cores": 99}, "cores: 99 there, "),
        ({"kernel": "2.6.32"}, "kernel: 2.6.32 there, "),
        ({"numpy": "1.0"}, "numpy: 1.0 there, "),
        ({"onnxruntime": None}, "onnxruntime: None there, "),
    ],
)
def test_figures_of_another_machine_or_installation_are_refused_and_it_is_said(kept, changes, said):
    found, refused = changed(kept, **changes)
    assert found is None
    assert f"({said}" in refused
    assert "--measure" in refused


def test_a_few_megabytes_that_a_kernel_keeps_are_no_other_machine(kept):
    here = json.loads(kept.read_text())["identity"]["RAM in MB"]
    assert changed(kept, **{"RAM in MB": round(here * 0.99)})[0]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", '{"format": 3}', '{"format": 3, "trials": 3}', '{"score": {}}']
)
def test_a_file_that_cannot_be_read_is_said_and_not_used(tmp_path, text):
    path = tmp_path / "m.json"
    path.write_text(text)
    assert_unreadable(path)


def assert_unreadable(path):
    figures, refused = load(path)
    assert figures is None
    assert refused.startswith(f"{path} holds no figures ")


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (["trials", 0, "costs", "encode"], 0.1),
        (["trials", 0, "costs", "scanned"], 1),
        (["score", "single"], 0),
        (["score", "products"], "quick"),
    ],
)
def test_figures_that_are_none_are_said_and_not_used(kept, keys, value):
    fields = json.loads(kept.read_text())
    at = fields
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    kept.write_text(json.dumps(fields))
    assert_unreadable(kept)


def test_another_version_of_the_file_is_said_and_no_file_is_nothing_to_say(kept):
    kept.write_text('{"format": 2}')
    assert "another version" in load(kept)[1]
    assert load(kept.with_name("none.json")) == (None, None)


def test_what_is_stored_is_not_tried_again_and_what_is_not_is(kept, monkeypatch):
    def try_each(wanted, threads):
        for offer in wanted:
            asked.append(offer.label)
            yield Trial(
                label=offer.label,
                name=offer.name,
                settings=offer.settings,
                problem="No." if offer.name == "calc" else None,
            )
            if offer.name == "calc":
                return

    asked = []
    monkeypatch.setattr(measured, "try_each", try_each)
    stored, _ = load(kept)
    wanted = [
        *(Offer(label, "calc", {}) for label in ("calc", "calc 8bit")),
        *(Offer("hog", "hog", {}), Offer("hog 1bit", "hog", {"form": "1bit"}), Offer("cohog", "cohog", {})),
    ]
    found = list(known_and_tried(wanted, load_board("rpi-4b"), stored))
    assert asked == ["calc", "hog"], "what could not be used then is tried again"
    assert [(trial.label, known) for trial, known in found] == [
        ("calc", False), ("hog", False), ("hog 1bit", True), ("cohog", True),
    ], "in the order of preference"  # fmt: skip


def test_settings_that_are_the_defaults_are_the_same_and_others_are_not(kept):
    stored, _ = load(kept)
    assert stored.of(Offer("cohog", "cohog", {"gt": 0.4})) == COHOG
    assert stored.of(Offer("cohog", "cohog", {"gt": 0.7})) is None


def test_figures_of_another_network_are_not_used(kept, monkeypatch):
    fingerprints = {"calc": "old"}
    monkeypatch.setattr(trial, "load_card", lambda name: type("Card", (), {"fingerprint": fingerprints[name]}))
    path = kept
    save(gathered([Trial(label="calc", name="calc", settings={}, costs=COSTS, model="old")], "", 1, SCORE), path)
    stored, _ = load(path)
    assert stored.of(Offer("calc", "calc", {})) is not None
    fingerprints["calc"] = "new"
    assert stored.of(Offer("calc", "calc", {})) is None


def test_a_file_is_replaced_as_a_whole_or_stays_as_it_was(kept, monkeypatch):
    before = kept.read_bytes()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(measured.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save(gathered([COHOG], "", 1, SCORE), kept)
    assert kept.read_bytes() == before
    assert [path.name for path in kept.parent.iterdir()] == [kept.name]


def test_where_nothing_can_be_written_is_said_before_the_work(tmp_path, monkeypatch):
    with pytest.raises(UsageError, match="folder"):
        require_room(tmp_path / "no" / "m.json", make=False)
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(EdgevprError, match="written"):
        require_room(tmp_path / "folder.json", make=False)
    with pytest.raises(UsageError, match="json"):
        require_room(tmp_path / "valley.gpkg", make=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    require_room(default_path(), make=True)
    assert default_path() == tmp_path / "data/edgevpr/measured.json"
    assert default_path().parent.is_dir()
    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    with pytest.raises(UsageError, match="XDG_DATA_HOME"):
        require_room(default_path(), make=True)


def test_pictures_are_spread_over_the_folder_and_looked_at_first(tmp_path):
    for number in range(20):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((32, 32), number, np.uint8))
    paths, said = pictures_of(str(tmp_path))
    assert [path.stem for path in paths] == ["0", "2", "5", "7", "10", "12", "15", "17"]
    assert said == f"8 pictures of {tmp_path}"
    assert pictures_of(None) == ([], "8 generated pictures")
    (tmp_path / "10.png").write_text("no picture")
    with pytest.raises(ImageError, match=r"10\.png"):
        pictures_of(str(tmp_path))
    with pytest.raises(SourceError, match="nowhere"):
        pictures_of(str(tmp_path / "nowhere"))


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


def test_the_table_names_machine_date_pictures_and_every_technique(kept):
    found, _ = load(kept)
    first, heads, cohog, hog, calc, what, why, score = format_stored(found).splitlines()
    assert first.startswith(found.identity["machine"])
    assert first.endswith(f"measured on {found.date}, 8 generated pictures")
    assert cohog.split() == [
        "cohog", "100.00", "200.00", "4000.000", "5000.000", "2.000", "88.5", "11.0", "90", "31776",
    ]  # fmt: skip
    assert hog.split()[2:] == ["100.00", "200.00", "4000.000", "5000.000", "-", "88.5", "-", "90", "31776"]
    assert calc.split() == ["calc", "n/a"]
    assert why.startswith("calc cannot")
    assert score.endswith("products 0.1, passes 0.4, all cores 0.7 (single 0.2).")
    assert max(len(heads), len(cohog), len(what)) <= 120


def meter_at(held, watts, title="INA3221 (hwmon1), channel VDD_IN", certain=True):
    return Meter(title=title, period_s=0.05, look=lambda: watts(held[-1]), certain=certain)


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
    monkeypatch.setattr(sensors, "find_meters", lambda: (meter,))
    path, said = measured_profile(tmp_path / "measured.json", SCORE)
    board = load_board(str(path))
    assert (board.idle_w, board.full_w, board.verified) == (pytest.approx(2.0), pytest.approx(6.5), True)
    assert meter.title in board.source
    assert board.benchmark_score == SCORE
    assert path.parent == tmp_path
    assert path.name.startswith("measured-")
    assert said.startswith("Power: 2 W idle, 6.5 W ")
    assert "5/5  load 100%" in capsys.readouterr().err


def test_without_a_meter_it_is_one_line_and_no_file(monkeypatch, tmp_path):
    monkeypatch.setattr(sensors, "find_meters", tuple)
    assert measured_profile(tmp_path / "m.json", SCORE) == (None, sensors.NO_METER)
    assert not list(tmp_path.iterdir())


def test_a_meter_that_says_nonsense_leaves_no_file(monkeypatch, tmp_path, held):
    monkeypatch.setattr(sensors, "find_meters", lambda: (meter_at(held, lambda share: float("nan")),))
    with pytest.raises(MeterError, match="nan W"):
        measured_profile(tmp_path / "m.json", SCORE)
    assert not list(tmp_path.iterdir())


def test_a_file_is_never_overwritten(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("precious")
    with pytest.raises(UsageError, match=r"mine\.yaml"):
        require_new_profile(path)
    with pytest.raises(EdgevprError, match=r"mine\.yaml"):
        write_profile(path, own_profile(SCORE))
    assert path.read_text() == "precious"
    assert [each.name for each in tmp_path.iterdir()] == ["mine.yaml"]


@pytest.mark.parametrize("name", ["mine.json", "no/mine.yaml"])
def test_a_name_that_makes_no_profile_is_one_sentence(tmp_path, name):
    with pytest.raises(UsageError, match=name):
        require_new_profile(tmp_path / name)
