"""The mask from the file to the match: used by map and query."""

import cv2
import numpy as np
import pytest
from pictures import textured

from edgevpr.cli.main import main
from edgevpr.core.config import load_config
from edgevpr.core.types import Frame
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import open_recogniser

PLACES = 24


def shown(picture):
    """The picture with a display over it: two panels of figures, the same in every frame."""
    shown = picture.copy()
    shown[:60], shown[190:] = 0, 0
    for line, row in enumerate((25, 50, 215, 235)):
        cv2.putText(shown, f"{line} BAT 16.2V RSSI 87 HOME 412m ALT", (3, row), cv2.FONT_HERSHEY_PLAIN, 1.1, 255, 1)
    return shown


def view(number):
    return textured(number, 240, 320)


def dusk(number):
    """The same place with less light and more noise."""
    noise = np.random.default_rng(number).normal(0, 20, (240, 320))
    return np.clip(0.6 * view(number) + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("masked")
    (folder / "ref").mkdir()
    for number in range(PLACES):
        cv2.imwrite(str(folder / "ref" / f"{number:02d}.png"), shown(view(number)))
    cv2.imwrite(str(folder / "mask.png"), np.where(shown(np.full((240, 320), 7, np.uint8)) == 7, 255, 0))
    built = ["map", "build", "--images", str(folder / "ref"), "--technique", "cohog", "--param", "w1=208"]
    assert main([*built, str(folder / "plain.gpkg")]) == 0
    assert main([*built, str(folder / "masked.gpkg"), "--mask", str(folder / "mask.png")]) == 0
    return folder


def opened(folder, name, mask):
    settings = {"map": str(folder / name), "source.mask": str(folder / "mask.png") if mask else None}
    return open_recogniser(load_config(None, settings), load_board("this"))


@pytest.mark.slow
def test_mask_finds_more_places_behind_a_display(folder):
    found = {}
    for name, mask in (("plain.gpkg", False), ("masked.gpkg", True)):
        walk = opened(folder, name, mask)
        with walk.place_map:
            events = [walk.step(Frame(image=shown(dusk(n)), name=str(n), t_mono_s=0.0)) for n in range(PLACES)]
        assert all(e.best.place.source_image == f"{n:02d}.png" for n, e in enumerate(events) if e.accepted)
        found[name] = sum(e.best.place.source_image == f"{n:02d}.png" for n, e in enumerate(events))
    assert found["masked.gpkg"] > found["plain.gpkg"], "what all places share says nothing of any"
