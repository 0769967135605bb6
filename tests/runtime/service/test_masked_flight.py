"""The mask from the file to the match: used by map and query."""

import cv2
import numpy as np
from pictures import draw_texture, write_flight

from edgevpr.cli.main import main
from edgevpr.core.config import load_config
from edgevpr.core.types import Frame
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import open_recogniser


def draw_display(place, figures):
    """The picture of a place behind a display: two panels of figures."""
    picture = draw_texture(place, 240, 320)
    picture[:60], picture[190:] = 0, 0
    for row in (25, 50, 215, 235):
        cv2.putText(picture, figures, (3, row), cv2.FONT_HERSHEY_PLAIN, 1.1, 255, 1)
    return picture


def test_mask_of_map_and_flight_excludes_a_display(tmp_path):
    write_flight(tmp_path / "ref", [draw_display(place, "BAT 16.2V HOME 412m ALT") for place in range(4)])
    allowed = np.full((240, 320), 255, np.uint8)
    allowed[:60], allowed[190:] = 0, 0
    cv2.imwrite(str(tmp_path / "mask.png"), allowed)
    settings = {"map": str(tmp_path / "m.gpkg"), "source.mask": str(tmp_path / "mask.png")}
    flags = ["--images", str(tmp_path / "ref"), "--mask", settings["source.mask"], "--technique", "cohog"]
    assert main(["map", "build", settings["map"], *flags]) == 0
    walk = open_recogniser(load_config(None, settings), load_board("this"))
    with walk.place_map:
        seen = [draw_display(2, figures) for figures in ("BAT 16.2V HOME 412m ALT", "RSSI 87")]
        same, other = (walk.step(Frame(image=image, name="", t_mono_s=0.0)) for image in seen)
    assert same.best.place.source_image == "2.png"
    assert other.best == same.best
    assert (seen[0] != seen[1]).any()
