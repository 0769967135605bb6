"""The text of a calibration in a map: it comes back as it was, and damage is seen."""

from dataclasses import replace

import pytest

from edgevpr.runtime.recognise.confidence import prior
from edgevpr.runtime.recognise.evidence import MapCalibration, calibration_text, not_calibrated, read_calibration

FOUND = MapCalibration(
    models={"down": prior("down")},
    made="2026-05-01",
    asked=120,
    precision=0.999,
    accepted=0.75,
    accepted_wrong=1,
    recognisable={3: 0.2, 7: 0.95, 12: 0.5, 40: 1.0},
)


def test_a_calibration_comes_back_as_it_was():
    assert read_calibration(calibration_text(FOUND)) == FOUND


@pytest.mark.parametrize("at", [0, 7, 8, 40, 400, -1])
def test_any_changed_letter_is_seen(at):
    letters = list(calibration_text(FOUND))
    letters[at] = "7" if letters[at] != "7" else "8"
    with pytest.raises(ValueError, match="checksum"):
        read_calibration("".join(letters))


@pytest.mark.parametrize("text", ["", "0", "00000000", "\ud800" * 9, "[" * 100_000])
def test_a_text_that_is_none_is_refused(text):
    with pytest.raises(ValueError, match=r"checksum|calibration|Expecting"):
        read_calibration(text)


@pytest.mark.parametrize(
    "wrong",
    [
        {"accepted": 1.5},
        {"accepted": float("nan")},
        {"precision": float("inf")},
        {"recognisable": {1: -0.1}},
        {"recognisable": {"x": 0.5}},
        {"recognisable": None},
        {"asked": None},
        {"asked": float("inf")},
        {"models": {}, "accepted_wrong": "many"},
    ],
)
def test_figures_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match=r"share|calibration|number|invalid"):
        read_calibration(calibration_text(replace(FOUND, **wrong)))


def test_what_to_expect_is_said_in_words_and_figures():
    said = FOUND.described()
    assert said.startswith("of 120 changed pictures of its own places 75 % were accepted, at a precision of 99.9 %")
    assert "and 1 wrong match was; 25 % of 4 places are hardly recognisable" in said
    assert "looks alike" not in said
    figures = FOUND.figures()
    assert (figures["asked"], figures["places_asked"], figures["hardly_recognisable"]) == (120, 4, 0.25)
    assert figures["made_of"] == [prior("down").made_of]
    assert "no wrong match was" in replace(FOUND, accepted_wrong=0).described()
    assert "5 wrong matches were" in replace(FOUND, accepted_wrong=5).described()


def test_a_map_of_which_most_looks_alike_says_so():
    alike = replace(FOUND, recognisable={1: 0.1, 2: 0.49, 3: 0.9})
    assert alike.looks_alike
    assert alike.described().endswith("most of this map looks alike: expect few fixes over it")
    assert not replace(FOUND, recognisable={}).looks_alike


def test_a_map_that_is_not_calibrated_says_why():
    assert not_calibrated(12).startswith("not calibrated (12 places: fewer than 30)")
    assert "map calibrate" in not_calibrated(30)
