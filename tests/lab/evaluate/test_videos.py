"""Flights on video with their positions are a data set like folders of pictures, and give the same figures."""

import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import cv2
import pytest
from films import cut_in_half, film_of, overwrite_in_the_middle
from pictures import textured

from edgevpr.cli.main import main
from edgevpr.core.geodesy import moved
from edgevpr.lab.evaluate.videos import pictures_of

pytestmark = [pytest.mark.process, pytest.mark.slow]

PLACES, RATE_HZ, APART_M = 6, 2, 30
HOG = ("--techniques", "hog", "--param", "hog.w1=64")


def taken(kept):
    """Return what makes a folder of pictures in `kept` of a video."""
    return partial(pictures_of, kept=kept, rate_hz=None, progress=lambda items, total, label: items)


class Flight:
    """Places 30 m apart on a line to the north, as a folder of pictures and as pictures for a video. The camera turns
    by 10 degrees from picture to picture."""

    def __init__(self, folder, name, first=0, beyond_m=0.0, darker=1):
        self.name, self.pictures = name, []
        self.places = folder / "pictures" / name
        self.places.mkdir(parents=True)
        rows, self.times = ["file,lat,lon,yaw_deg,height_m"], ["time,lat,lon,yaw_deg,height_m"]
        for number in range(PLACES):
            place = first + number
            picture = cv2.cvtColor(textured(place) // darker, cv2.COLOR_GRAY2BGR)
            lat_deg, lon_deg = moved(47.0, 8.0, 0.0, place * APART_M + beyond_m)
            cv2.imwrite(str(self.places / f"{name}{number}.png"), picture)
            rows.append(f"{name}{number}.png,{lat_deg!r},{lon_deg!r},{10 * place},50")
            self.times.append(f"{number / RATE_HZ},{lat_deg!r},{lon_deg!r},{10 * place},50")
            self.pictures.append(picture)
        (self.places / "positions.csv").write_text("\n".join(rows))

    def film(self, video, *coding):
        """Film the flight, with its positions beside it, and return the path."""
        film_of(video, self.pictures, RATE_HZ, *coding)
        video.with_suffix(".csv").write_text("\n".join(self.times))
        return video


@pytest.fixture
def mapping(tmp_path):
    return Flight(tmp_path, "ref")


@pytest.fixture
def later(tmp_path):
    return Flight(tmp_path, "query", first=1, beyond_m=11.0, darker=2)


@pytest.fixture
def films(tmp_path, mapping, later):
    """Both flights as videos without losses: later.mkv and mapping.mkv with their tables."""
    return later.film(tmp_path / "later.mkv"), mapping.film(tmp_path / "mapping.mkv")


def measured(capsys, *arguments):
    assert main(["eval", *HOG, "--json", *map(str, arguments)]) == 0
    return json.loads(capsys.readouterr().out)


def quality(found):
    (row,) = found["techniques"].values()
    return {key: value for key, value in row.items() if not key.startswith(("t_", "u_", "ah_", "pcu"))}


def test_videos_give_the_figures_of_the_folders_of_their_pictures(films, mapping, later, capsys):
    flags = "--within-m", "20"
    of_folders = measured(capsys, "--query", later.places, "--ref", mapping.places, *flags)
    of_videos = measured(capsys, "--query", films[0], "--ref", films[1], *flags)
    assert quality(of_videos) == quality(of_folders)
    assert quality(of_videos)["queries"] == PLACES - 1, "one lies beyond the map"
    mixed = measured(capsys, "--query", films[0], "--ref", mapping.places, *flags)
    assert quality(mixed) == quality(of_folders)


def bad_bytes(video):
    coding = "-c:v", "libx264", "-bf", "0", "-sc_threshold", "0"
    film_of(video, [cv2.cvtColor(textured(at), cv2.COLOR_GRAY2BGR) for at in range(PLACES)], RATE_HZ, "-y", *coding)
    overwrite_in_the_middle(video)


def table_of(text):
    return lambda video: video.with_suffix(".csv").write_text(text)


@pytest.mark.parametrize(
    ("harm", "code", "said"),
    [
        (lambda video: video.with_suffix(".csv").unlink(), 2, "later.mkv has no positions beside it: write later.csv"),
        (table_of("time,lat,lon\n2026-02-14T06:10:00Z,47,8\n2026-02-14T06:10:05Z,47,8\n"), 2, "from its first frame"),
        (table_of("time,lat,lon\n-10,47,8\n10,47,8\n"), 2, "later.csv that are at most 5 s apart"),
        (table_of("file,lat,lon\na.jpg,47,8\n"), 2, "line 1 has no column `time`"),
        (lambda video: video.write_text("not a video"), 1, "later.mkv is not a video that can be decoded"),
        (lambda video: video.unlink(), 1, "later.mkv cannot be listed"),
        (bad_bytes, 1, "cannot be used, being damaged"),
        (cut_in_half, 1, "copy the video again"),
    ],
)
def test_what_cannot_be_used_is_said_in_one_sentence(harm, code, said, films, capsys):
    harm(films[0])
    assert main(["eval", *HOG, "--query", str(films[0]), "--ref", str(films[1])]) == code
    lines = [line for line in capsys.readouterr().err.splitlines() if ": pictures  " not in line]
    assert len(lines) == 1
    assert said in lines[0]


def test_killed_while_pictures_are_taken_it_goes_on_with_the_next_run(films, tmp_path):
    """As after a power cut: what is half taken is never believed."""
    kept = tmp_path / "kept"
    code = (
        "import os, signal, sys\nfrom pathlib import Path\nfrom edgevpr.lab.evaluate import videos\n"
        "write = videos.write_png\n"
        "def dying(path, image):\n    write(path, image)\n"
        "    '3' in path.name and os.kill(os.getpid(), signal.SIGKILL)\n"
        "videos.write_png = dying\n"
        "videos.pictures_of(Path(sys.argv[2]), Path(sys.argv[1]), None, lambda items, total, label: items)\n"
    )
    root = Path(__file__).parents[3]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-c", code, str(kept), str(films[0])], env=environment)
    assert done.returncode == -signal.SIGKILL
    assert list(kept.glob("[!.]*")) == []
    assert len(list(taken(kept)(films[0]).glob("*.png"))) == PLACES
