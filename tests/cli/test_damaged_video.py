"""Maps of videos that came off the aircraft damaged: what is left out is said, counted, and an exit code of 1."""

import re

import pytest
from films import FRAMES, cut_in_half, film, overwrite_in_the_middle

from edgevpr.cli.main import main
from edgevpr.places.mapfile import PlaceMap

X264 = ("-c:v", "libx264", "-bf", "0", "-sc_threshold", "0")
MPEG4 = ("-c:v", "mpeg4", "-qscale:v", "3")


def built(video, capsys):
    """Build a map of the video: (exit code, places in the map, images that could not be used as the last line says,
    all that was said)."""
    path = video.with_suffix(".gpkg")
    code = main(["map", "build", str(path), "--images", str(video), "--technique", "hog"])
    said = capsys.readouterr().err
    unusable = re.findall(r"edgevpr: (\d+) images could not be used \(named above\)\.$", said.strip())
    with PlaceMap.open(path) as place_map:
        return code, len(place_map), int(unusable[0]) if unusable else 0, said


def test_of_a_whole_video_every_frame_is_mapped(tmp_path, capsys):
    assert built(film(tmp_path / "flight.mkv", *X264), capsys)[:3] == (0, FRAMES, 0)


def test_of_a_video_with_bad_bytes_the_frames_left_out_are_counted(tmp_path, capsys):
    video = film(tmp_path / "flight.mkv", *X264)
    overwrite_in_the_middle(video)
    code, places, unusable, said = built(video, capsys)
    assert (code, places + unusable) == (1, FRAMES)
    assert f" and {unusable - 1} after it" in said


@pytest.mark.parametrize("name", ["flight.mkv", "flight.avi", "flight.mp4"])
def test_of_half_a_video_the_cut_is_said_and_the_missing_frames_counted(name, tmp_path, capsys):
    video = film(tmp_path / name, *MPEG4, *(["-movflags", "+faststart"] if name.endswith("mp4") else []))
    cut_in_half(video)
    code, places, unusable, said = built(video, capsys)
    assert code == 1
    assert 10 < places < 60
    assert places + unusable == pytest.approx(FRAMES, abs=1)
    assert re.search(rf"{name} ends after 1\.[0-9] s of 3\.0 s: it is cut short: copy the video again\.", said)
