"""Flights on video with their positions are a data set like folders of pictures, and give the same figures."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from films import cut_in_half, film_of
from pictures import textured

from edgevpr.cli.main import main
from edgevpr.core.geodesy import moved
from edgevpr.lab.evaluate.evaluate import iterate_silently
from edgevpr.lab.evaluate.videos import extract_pictures

pytestmark = [pytest.mark.process, pytest.mark.slow]

PLACES = 6
RATE_HZ = 2
APART_M = 30


class Flight:
    """Places 30 m apart on a line to the north: `places`, a folder of pictures with positions, and `film`, a video
    without losses with its table. The camera turns by 10 degrees from picture to picture."""

    def __init__(self, folder, name, first=0, beyond_m=0.0, darker=1):
        self.places, self.film = folder / "pictures" / name, folder / f"{name}.mkv"
        self.places.mkdir(parents=True)
        pictures, tags = [], []
        for number in range(PLACES):
            pictures.append(cv2.cvtColor(textured(first + number) // darker, cv2.COLOR_GRAY2BGR))
            cv2.imwrite(str(self.places / f"{number}.png"), pictures[-1])
            lat_deg, lon_deg = moved(47.0, 8.0, 0.0, (first + number) * APART_M + beyond_m)
            tags.append(f"{lat_deg!r},{lon_deg!r},{10 * (first + number)},50")
        rows = [f"{number}.png,{tag}" for number, tag in enumerate(tags)]
        (self.places / "positions.csv").write_text("\n".join(["file,lat,lon,yaw_deg,height_m", *rows]))
        film_of(self.film, pictures, RATE_HZ)
        times = [f"{number / RATE_HZ},{tag}" for number, tag in enumerate(tags)]
        self.film.with_suffix(".csv").write_text("\n".join(["time,lat,lon,yaw_deg,height_m", *times]))


@pytest.fixture
def mapping(tmp_path):
    return Flight(tmp_path, "mapping")


@pytest.fixture
def later(tmp_path):
    return Flight(tmp_path, "later", first=1, beyond_m=11.0, darker=2)


def quality(capsys, query, ref):
    flags = ["--techniques", "hog", "--param", "hog.w1=64", "--within-m", "20", "--json"]
    assert main(["eval", *flags, "--query", str(query), "--ref", str(ref)]) == 0
    (row,) = json.loads(capsys.readouterr().out)["techniques"].values()
    return {key: value for key, value in row.items() if not key.startswith(("t_", "u_", "ah_", "pcu"))}


def test_eval_gives_the_same_figures_of_videos_as_of_their_pictures(mapping, later, capsys):
    expected = quality(capsys, later.places, mapping.places)
    assert expected["queries"] == PLACES - 1, "one lies beyond the map"
    assert quality(capsys, later.film, mapping.film) == expected
    assert quality(capsys, later.film, mapping.places) == expected


@pytest.mark.parametrize(
    ("harm", "code", "said"),
    [
        (lambda film: film.with_suffix(".csv").unlink(), 2, "later.mkv has no positions beside it: write later.csv"),
        (
            lambda film: film.with_suffix(".csv").write_text("time,lat,lon\n-10,47,8\n10,47,8\n"),
            2,
            "later.csv that are at most 5 s apart",
        ),
        (lambda film: film.write_text("not a video"), 1, "later.mkv is not a video that can be decoded"),
        (cut_in_half, 1, "copy the video again"),
    ],
)
def test_eval_refuses_an_unusable_video_in_one_sentence(harm, code, said, mapping, later, capsys):
    harm(later.film)
    assert main(["eval", "--techniques", "hog", "--query", str(later.film), "--ref", str(mapping.film)]) == code
    lines = [line for line in capsys.readouterr().err.splitlines() if ": pictures  " not in line]
    assert len(lines) == 1
    assert said in lines[0]


def test_extract_pictures_ignores_what_a_killed_run_left(later, tmp_path):
    cache = tmp_path / "cache"
    code = (
        "import os, signal, sys\nfrom pathlib import Path\nfrom edgevpr.lab.evaluate import videos\n"
        "write = videos.write_png\n"
        "def dying(path, image):\n    write(path, image)\n"
        "    '3' in path.name and os.kill(os.getpid(), signal.SIGKILL)\n"
        "videos.write_png = dying\n"
        "videos.extract_pictures(Path(sys.argv[2]), Path(sys.argv[1]), None, lambda items, total, label: items)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    done = subprocess.run([sys.executable, "-c", code, str(cache), str(later.film)], env=environment)
    assert done.returncode == -signal.SIGKILL
    assert list(cache.glob("[!.]*")) == []
    assert len(list(extract_pictures(later.film, cache, None, iterate_silently).glob("*.png"))) == PLACES
