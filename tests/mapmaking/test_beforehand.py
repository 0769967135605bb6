"""What `map build` says of the pictures before it makes a map of them, and of the ground that the map covers."""

import json

import cv2
import numpy as np
import pytest

from edgevpr.cli.main import main

pytestmark = pytest.mark.slow

NOISE = cv2.GaussianBlur(np.random.default_rng(3).random((1500, 1500), np.float32), (0, 0), 3)
GROUND = cv2.normalize(NOISE, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
XMP = '<x:xmpmeta><rdf:Description drone-dji:GimbalYawDegree="0" drone-dji:GimbalPitchDegree="{}" '
XMP += 'drone-dji:GimbalRollDegree="0"/></x:xmpmeta>'


def down(number):
    """A picture of a camera that looks down, and moves up the picture by a quarter of it."""
    return GROUND[1200 - 60 * number :, 500:][:240, :320]


def ahead(number):
    """A picture of a camera that looks ahead: the same things, larger."""
    half = 300 / 1.08**number
    rows, columns = (slice(round(750 - share * half), round(750 + share * half)) for share in (0.75, 1))
    return cv2.resize(GROUND[rows, columns], (320, 240), interpolation=cv2.INTER_AREA)


def with_xmp(path, pitch_deg):
    """Write into a JPEG that its gimbal had this pitch."""
    content, packet = path.read_bytes(), b"http://ns.adobe.com/xap/1.0/\0" + XMP.format(pitch_deg).encode()
    path.write_bytes(content[:2] + b"\xff\xe1" + (len(packet) + 2).to_bytes(2, "big") + packet + content[2:])


@pytest.fixture
def folder(tmp_path):
    def written(view, lines=(), pitch_deg=None):
        (tmp_path / "images").mkdir()
        for number in range(8):
            path = tmp_path / "images" / f"{number}.jpg"
            cv2.imwrite(str(path), view(number))
            if pitch_deg is not None:
                with_xmp(path, pitch_deg)
        if lines:
            (tmp_path / "positions.csv").write_text("\n".join(["file,lat,lon", *lines]) + "\n")
        return tmp_path

    return written


def build(folder, *flags, images="images"):
    built = ["map", "build", str(folder / "m.gpkg"), "--images", str(folder / images), "--technique", "cohog", "--json"]
    return main([*built, "--no-refine", *flags])


@pytest.mark.parametrize(
    ("view", "pitch_deg", "code"),
    [(down, None, 2), (ahead, None, 0), (down, -10, 0), (ahead, -85, 2)],
    ids=["down", "ahead", "a gimbal that looks ahead", "a gimbal that looks down"],
)
def test_a_camera_that_looks_down_must_be_said_to(folder, view, pitch_deg, code):
    here = folder(view, pitch_deg=pitch_deg)
    assert build(here) == code
    assert (here / "m.gpkg").exists() == (code == 0)


def warnings_of(caplog):
    return [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]


def test_what_a_map_will_lack_is_said_before_it_is_made(folder, caplog):
    lines = [f"{number}.jpg,0,0" for number in range(8)]
    assert build(folder(ahead, lines)) == 0
    at_zero, nowhere, few = warnings_of(caplog)[:3]
    assert "8 lines are at 0, 0" in at_zero
    assert "no position was found" in nowhere
    assert "8 places at most" in few


def test_the_ground_of_a_map_is_measured(folder, capsys):
    lines = [f"{number}.jpg,{50 + 0.001 * number:.3f},{8 if number % 2 else 8.001}" for number in range(8)]
    assert build(folder(ahead, lines), "--no-calibrate") == 0
    covered = json.loads(capsys.readouterr().out)["covered"]
    assert covered["north_south_m"] == pytest.approx(778, abs=2)
    assert covered["east_west_m"] == pytest.approx(71, abs=1)
    assert (covered["lat_deg"], covered["lon_deg"]) == (pytest.approx(50.0035), pytest.approx(8.0005))
    assert covered["step_m"] == pytest.approx(132, abs=1)
    assert covered["track_m"] == pytest.approx(7 * 132, abs=5)
