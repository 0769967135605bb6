"""Staticity by real detectors, where their files are there: none of them is part of edgevpr."""

import os
from pathlib import Path

import detectors
import numpy as np
import pytest

from edgevpr.frames.images import read_image
from edgevpr.runtime.recognise.gate_networks import Detector
from edgevpr.techniques.card import load_card

DATA = Path(os.environ.get("EDGEVPR_DATA") or Path(__file__).resolve().parents[4] / "shared" / "data")
HALL = DATA / "grief_michigan_monthly" / "query" / "m07_loc04.jpg"  # a person stands in it


@pytest.mark.parametrize("name", detectors.NAMES)
def test_a_person_is_taken_out_and_the_hall_stays(name, tmp_path, monkeypatch):
    if not HALL.is_file() or not detectors.is_there(name):
        pytest.skip(f"needs {HALL} and {detectors.FILES / name}; set EDGEVPR_DATA and EDGEVPR_DETECTORS")
    monkeypatch.setenv("EDGEVPR_MODELS", str(tmp_path))
    detectors.write_card(name, tmp_path)
    static = Detector(load_card(name)).is_static(np.ascontiguousarray(read_image(HALL)[40:240, 60:260]))
    person = np.zeros((200, 200), bool)
    person[98:, 108:164] = True
    overlap = (person & ~static).sum() / (person | ~static).sum()
    assert overlap > 0.8
