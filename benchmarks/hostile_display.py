"""A display over every frame of a generated flight: what is recognised without a mask, and with the one that
`edgevpr check --learn-mask` learns."""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from edgevpr.frames.images import list_images
from edgevpr.lab.simulate.flight import fly_and_write

LABELS = ("BAT", "ALT", "SPD", "HOME", "GPS", "RSSI", "MODE", "TIME")
SPOTS = ((20, 40), (480, 40), (20, 460), (480, 460), (260, 40), (20, 250), (500, 250), (260, 460))
WHITE, BLACK = (255, 255, 255), (0, 0, 0)
NEAR_M = 30.0  # a right place: the places are 21 m apart
WRONG_M = 60.0  # beyond it, picture and place show hardly any common ground


def with_display(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw labels that stay, figures that change, a frame, a cross and two scales over a picture of 640x480."""
    for spot, label in zip(SPOTS, LABELS, strict=True):
        text = f"{label}{rng.integers(100, 999)}"
        for colour, thickness in ((BLACK, 6), (WHITE, 2)):
            cv2.putText(picture, text, spot, cv2.FONT_HERSHEY_SIMPLEX, 0.9, colour, thickness, cv2.LINE_AA)
    cv2.drawMarker(picture, (320, 240), WHITE, cv2.MARKER_CROSS, 60, 3)
    cv2.rectangle(picture, (120, 90), (520, 390), WHITE, 2)
    for row in range(100, 400, 20):
        cv2.line(picture, (590, row), (620, row), WHITE, 3)
        cv2.line(picture, (10, row), (40, row), WHITE, 3)
    return picture


def flown(folder: Path, which: str, seed: int) -> None:
    """Write a flight into `folder`/clean/`which`, and the same behind a display into `folder`/shown/`which`."""
    fly_and_write(folder / "clean" / which, which, seed)
    there = folder / "shown" / which
    (there / "images").mkdir(parents=True)
    shutil.copy(folder / "clean" / which / "positions.csv", there)
    rng = np.random.default_rng((seed, len(which)))
    for path in list_images(folder / "clean" / which / "images"):
        picture = with_display(cv2.imread(str(path)), rng)
        cv2.imwrite(str(there / "images" / path.name), picture, (cv2.IMWRITE_JPEG_QUALITY, 80))


def asked(folder: Path, flight: str, *flags: str) -> str:
    """Map one flight, match the other, and say in a line what came of it."""
    place_map = folder / f"{flight}{len(flags)}.gpkg"
    images = {which: str(folder / flight / which / "images") for which in ("map", "query")}
    technique = ("--technique", "cohog", "--camera", "nadir")
    edgevpr("map", "build", str(place_map), "--images", images["map"], *technique, *flags)
    found = json.loads(edgevpr("match", str(place_map), "--images", images["query"], "--json", *flags))
    errors_m = [each.get("error_m", np.inf) for each in found]
    accepted_m = [error for error, each in zip(errors_m, found, strict=True) if each["accepted"]]
    near, wrong = sum(error < NEAR_M for error in errors_m), sum(error > WRONG_M for error in accepted_m)
    return (
        f"{len(found)} queries, {near} best places within {NEAR_M:g} m, {len(accepted_m)} accepted, {wrong} of them "
        f"more than {WRONG_M:g} m off"
    )


def edgevpr(*arguments: str) -> str:
    done = subprocess.run([sys.executable, "-m", "edgevpr", *arguments], capture_output=True, text=True, check=True)
    return done.stdout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=12)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="edgevpr-display-") as temporary:
        folder = Path(temporary)
        for which in ("map", "query"):
            flown(folder, which, args.seed)
        config, mask = folder / "c.yaml", folder / "mask.png"
        config.write_text("log: {path: null}\n")
        recording = str(folder / "shown" / "map" / "images")
        print(edgevpr("check", "--config", str(config), "--learn-mask", str(mask), "--source", recording), end="")
        print("no display:        ", asked(folder, "clean"))
        print("display:           ", asked(folder, "shown"))
        print("display and mask:  ", asked(folder, "shown", "--mask", str(mask)))


if __name__ == "__main__":
    main()
