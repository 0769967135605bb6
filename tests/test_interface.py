"""The Python interface, and the scripts in examples/ that use it, run as a user runs them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import expect_refusal, run_json
from pictures import draw_texture, render_view

import edgevpr
from edgevpr.cli.main import main
from edgevpr.core.errors import ImageError, MapError, SourceError, UsageError
from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.types import Position

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[1] / "examples"
PLACES = 6


def draw_view(place, rotation_deg=0.0):
    """The ground at a place, seen from straight above."""
    return render_view(draw_texture(place, 800, 800), 320, rotation_deg)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Mapped pictures with positions in mapped/, the same turned and darker in later/."""
    folder = tmp_path_factory.mktemp("flight")
    rows = ["file,lat,lon,yaw_deg"]
    for side in ("mapped", "later"):
        (folder / side).mkdir()
    for place in range(PLACES):
        cv2.imwrite(str(folder / "mapped" / f"{place}.jpg"), draw_view(place))
        cv2.imwrite(str(folder / "later" / f"{place}.jpg"), cv2.convertScaleAbs(draw_view(place, 45), alpha=0.8))
        rows.append(f"{place}.jpg,{50 + 0.002 * place:.6f},8,0")
    (folder / "mapped" / "positions.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.fixture(scope="module")
def valley(flight):
    path = flight / "valley.gpkg"
    done = []
    options = {"camera": "nadir", "calibrate": False, "progress": lambda *step: done.append(step)}
    made = edgevpr.build(path, flight / "mapped", **options)
    assert done[:PLACES] == [(number, PLACES, "mapping") for number in range(1, PLACES + 1)]
    assert (made.technique, made.places, made.with_position) == ("cohog", PLACES, PLACES)
    return path


def test_map_match_returns_position_and_confidence(flight, valley):
    with edgevpr.Map(valley) as ground:
        assert len(ground) == PLACES
        assert [place.source_image for place in ground.places()] == [f"{place}.jpg" for place in range(PLACES)]
        match = ground.match(cv2.imread(str(flight / "later" / "3.jpg")))
        assert match.accepted
        assert match.place.source_image == "3.jpg"
        assert match.position.lat_deg == pytest.approx(50.006, abs=1e-4)
        assert match.confidence > 0.999
        assert min(abs(wrap_deg(match.rotation_deg - turn_deg)) for turn_deg in (45, 315)) <= 15
        assert match.t_query_s > 0
        feature = json.loads(json.dumps(match.geojson()))
        assert feature["geometry"]["coordinates"] == [match.position.lon_deg, match.position.lat_deg]
        nothing = ground.match(np.full((240, 320, 3), 90, np.uint8))
        assert (nothing.accepted, nothing.position, nothing.geojson()["geometry"]) == (False, None, None)
        assert nothing.reason


def test_map_match_uses_the_given_hints(flight, valley):
    picture = cv2.imread(str(flight / "later" / "3.jpg"))
    with edgevpr.Map(valley) as ground:
        rotation_deg = ground.match(picture).rotation_deg
        assert ground.match(picture, heading_deg=rotation_deg).accepted
        assert not ground.match(picture, heading_deg=rotation_deg + 90).accepted
        assert ground.match(picture, near=Position(50.006, 8.0)).accepted


def test_interface_raises_errors_of_edgevpr(flight, valley, tmp_path):
    with pytest.raises(MapError, match="nowhere"):
        edgevpr.Map(tmp_path / "nowhere.gpkg")
    with edgevpr.Map(valley) as ground:
        for image in (None, "x.jpg", [[1, 2]], *(np.zeros(shape, np.uint8) for shape in ((9,), (3, 9, 9), (0, 9)))):
            with pytest.raises(ImageError, match="of uint8"):
                ground.match(image)
        for kind in (np.float64, np.uint16):
            with pytest.raises(ImageError, match="of uint8"):
                ground.match(draw_view(1).astype(kind))
        for known in ({"heading_deg": "north"}, {"height_m": float("nan")}, {"near": (50.0, 8.0)}, {"t_s": "now"}):
            with pytest.raises(UsageError, match=next(iter(known))):
                ground.match(draw_view(1), **known)
    with pytest.raises(UsageError, match="closed"):
        ground.match(draw_view(1))
    for wrong in (None, 3):
        with pytest.raises(UsageError, match="path"):
            edgevpr.Map(wrong)
        with pytest.raises(UsageError, match="path"):
            edgevpr.build(tmp_path / "m.gpkg", wrong)
    with edgevpr.Map(valley, fov_deg=60) as ground, pytest.raises(UsageError, match="height_m"):
        ground.match(draw_view(1))
    grid = edgevpr.OrthophotoGrid(orthophoto="nothing.tif", footprint_m=100.0, spacing_m=25.0)
    with pytest.raises(SourceError, match="nothing"):
        edgevpr.build(tmp_path / "m.gpkg", grid)
    with pytest.raises(AttributeError):
        edgevpr.Mop  # noqa: B018


@pytest.mark.process
@pytest.mark.parametrize("module", ["edgevpr", "edgevpr.cli"])
def test_import_loads_heavy_packages_only_when_needed(module):
    code = f"import sys, {module}; print(*sys.modules); edgevpr.Map; assert 'numpy' in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"av", "cv2", "numpy", "onnxruntime", "pymavlink", "yaml", "psutil", "serial"}
    assert not heavy & set(done.stdout.split())


@pytest.mark.process
@pytest.mark.parametrize(
    ("script", "more", "said"),
    [
        ("build_and_match.py", ["{flight}/mapped", "{flight}/later", "{tmp}/m.geojson"], "3.jpg  50.006"),
        ("own_frames.py", ["{valley}", "{flight}/later"], "5.0 s  yes"),
        ("to_ros2.py", ["{valley}", "{flight}/later"], "pose "),
    ],
)
def test_examples_run(flight, valley, tmp_path, script, more, said):
    words = [word.format(flight=flight, valley=valley, tmp=tmp_path) for word in more]
    done = subprocess.run([sys.executable, EXAMPLES / script, *words], capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stderr
    assert said in done.stdout
    if script == "build_and_match.py":
        assert len(json.loads((tmp_path / "m.geojson").read_text())["features"]) == PLACES


@pytest.mark.process
def test_film_with_subtitles_example_runs(flight, tmp_path, capsys, caplog):
    (tmp_path / "images").symlink_to(flight / "mapped")
    lines = (flight / "mapped" / "positions.csv").read_text().splitlines()
    rows = [f"{lines[0]},alt,height_m", *(f"{x},250,80" for x in lines[1:])]
    (tmp_path / "positions.csv").write_text("\n".join(rows))
    film = str(tmp_path / "DJI_0001")
    subprocess.run([sys.executable, EXAMPLES / "film_with_subtitles.py", tmp_path, film], check=True)
    build = ["--images", f"{film}.MP4", "--no-calibrate"]
    assert main(["map", "build", f"{film}_bare.gpkg", *build, "--technique", "hog"]) == 0
    assert "DJI_0001.SRT --images" in caplog.text, "the subtitles are there, and nobody has read them"
    assert "video" in expect_refusal(capsys, "positions", f"{film}.SRT", "--images", flight / "later")
    assert run_json(capsys, "positions", f"{film}.SRT", "--images", f"{film}.MP4")["placed"] == PLACES
    assert main(["map", "build", f"{film}.gpkg", *build, "--camera", "nadir"]) == 0
    with edgevpr.Map(f"{film}.gpkg") as ground:
        places = list(ground.places())
    assert [place.position.lat_deg for place in places] == pytest.approx([50 + 0.002 * at for at in range(PLACES)])
