"""What `map build` says of the pictures before it makes a map of them, of a display that is drawn over all of them, and
of the ground that the map covers."""

import json

import cv2
import numpy as np
import pytest

from edgevpr.cli.main import main
from edgevpr.core.arrays import Image
from edgevpr.frames.mask import load_mask
from edgevpr.mapmaking.advice import measure_static_fraction

NOISE = cv2.GaussianBlur(np.random.default_rng(3).random((1500, 1500), np.float32), (0, 0), 3)
GROUND = cv2.normalize(NOISE, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
XMP = '<x:xmpmeta><rdf:Description drone-dji:GimbalYawDegree="0" drone-dji:GimbalPitchDegree="{}" '
XMP += 'drone-dji:GimbalRollDegree="0"/></x:xmpmeta>'


def draw_downward_view(number):
    """A picture of a camera that looks down, and moves up the picture by a quarter of it."""
    return GROUND[1200 - 60 * number :, 500:][:240, :320]


def draw_forward_view(number):
    """A picture of a camera that looks ahead: the same things, larger."""
    half = 300 / 1.08**number
    rows, columns = (slice(round(750 - share * half), round(750 + share * half)) for share in (0.75, 1))
    return cv2.resize(GROUND[rows, columns], (320, 240), interpolation=cv2.INTER_AREA)


def add_xmp(path, pitch_deg):
    """Write into a JPEG that its gimbal had this pitch."""
    content, packet = path.read_bytes(), b"http://ns.adobe.com/xap/1.0/\0" + XMP.format(pitch_deg).encode()
    path.write_bytes(content[:2] + b"\xff\xe1" + (len(packet) + 2).to_bytes(2, "big") + packet + content[2:])


@pytest.fixture
def folder(tmp_path):
    def write_folder(view, lines=(), pitch_deg=None):
        (tmp_path / "images").mkdir()
        for number in range(8):
            path = tmp_path / "images" / f"{number}.jpg"
            cv2.imwrite(str(path), view(number))
            if pitch_deg is not None:
                add_xmp(path, pitch_deg)
        if lines:
            (tmp_path / "positions.csv").write_text("\n".join(["file,lat,lon", *lines]) + "\n")
        return tmp_path

    return write_folder


def build(folder, *flags, images="images"):
    built = ["map", "build", str(folder / "m.gpkg"), "--images", str(folder / images), "--technique", "cohog", "--json"]
    return main([*built, "--no-refine", *flags])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("view", "pitch_deg", "code"),
    [
        (draw_downward_view, None, 2),
        (draw_forward_view, None, 0),
        (draw_downward_view, -10, 0),
        (draw_forward_view, -85, 2),
    ],
    ids=["down", "ahead", "a gimbal that looks ahead", "a gimbal that looks down"],
)
def test_map_build_requires_camera_nadir_for_downward_images(folder, view, pitch_deg, code):
    here = folder(view, pitch_deg=pitch_deg)
    assert build(here, "--no-calibrate") == code
    assert (here / "m.gpkg").exists() == (code == 0)


@pytest.mark.slow
def test_map_build_reports_the_covered_ground(folder, capsys):
    lines = [f"{number}.jpg,{50 + 0.001 * number:.3f},{8 if number % 2 else 8.001}" for number in range(8)]
    assert build(folder(draw_forward_view, lines), "--no-calibrate") == 0
    covered = json.loads(capsys.readouterr().out)["covered"]
    assert covered["north_south_m"] == pytest.approx(778, abs=2)
    assert covered["east_west_m"] == pytest.approx(71, abs=1)
    assert (covered["lat_deg"], covered["lon_deg"]) == (pytest.approx(50.0035), pytest.approx(8.0005))
    assert covered["step_m"] == pytest.approx(132, abs=1)
    assert covered["track_m"] == pytest.approx(7 * 132, abs=5)


def ground_view(number: int) -> Image:
    return GROUND[20 * number :, 40 * number :][:240, :320].copy()


def draw_view_with_display(number: int) -> Image:
    """A picture with a height, which changes, and a cross."""
    image = cv2.cvtColor(ground_view(number), cv2.COLOR_GRAY2BGR)
    cv2.drawMarker(image, (160, 120), (255, 255, 255), cv2.MARKER_CROSS, 30, 2)
    cv2.putText(image, f"ALT {100 + number}", (8, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2)
    return image


def test_measure_static_fraction_finds_only_the_overlay():
    assert measure_static_fraction(map(ground_view, range(20)), None) == 0
    assert 0.006 < measure_static_fraction(map(draw_view_with_display, range(20)), None) < 0.05


def test_measure_static_fraction_leaves_out_the_mask(tmp_path):
    painted = np.full((240, 320), 255, np.uint8)
    painted[:45, :150] = painted[95:145, 135:185] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), painted)
    assert measure_static_fraction(map(draw_view_with_display, range(20)), load_mask(str(tmp_path / "mask.png"))) == 0


@pytest.mark.parametrize("numbers", [range(11), [3] * 20], ids=["few pictures", "an aircraft that stands"])
def test_measure_static_fraction_is_unknown_without_enough_evidence(numbers):
    assert measure_static_fraction(map(draw_view_with_display, numbers), None) is None


@pytest.mark.slow
def test_map_build_warns_of_a_display(tmp_path, caplog):
    for number in range(16):
        cv2.imwrite(str(tmp_path / f"{number:02d}.png"), draw_view_with_display(number))
    flags = "--technique", "cohog", "--camera", "nadir", "--no-refine", "--no-calibrate"
    assert main(["map", "build", str(tmp_path / "m.gpkg"), "--images", str(tmp_path), *flags]) == 0
    assert "--mask PNG" in caplog.text
