"""One recorded flight for all tests of flights: thirty places, 111 m apart on a line to the north, and maps of them."""

import csv

import cv2
import pytest
from flights import PLACES, STEP_DEG
from pictures import textured

from edgevpr.cli.main import main

# Small and quick: what flights are tested on here is not how well a technique recognises.
TECHNIQUES = {"cohog": ("w1=208",), "hog": ("w1=64",), "seqslam": ()}


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """`seen` are the pictures with their positions, `blind` the same without any, and there is a map of each
    technique."""
    folder = tmp_path_factory.mktemp("recording")
    for name in ("seen", "blind"):
        (folder / name / "images").mkdir(parents=True)
    with open(folder / "seen" / "positions.csv", "w", newline="") as handle:
        table = csv.writer(handle)
        table.writerow(("file", "lat", "lon"))
        for number in range(PLACES):
            name = f"{number:02d}.png"
            for each in ("seen", "blind"):
                cv2.imwrite(str(folder / each / "images" / name), textured(number, 240, 320))
            table.writerow((name, f"{50 + number * STEP_DEG:.4f}", 8.0))
    for technique, parameters in TECHNIQUES.items():
        flags = [word for parameter in parameters for word in ("--param", parameter)]
        built = ["map", "build", folder / f"{technique}.gpkg", "--images", folder / "seen" / "images"]
        assert main([*map(str, built), "--technique", technique, "--no-calibrate", *flags]) == 0
    return folder
