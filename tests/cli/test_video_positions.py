"""Maps of a video with its positions."""

import pytest
from films import film

from edgevpr.cli.main import main
from edgevpr.places.mapfile import PlaceMap


@pytest.fixture
def flight(tmp_path):
    """A flight of three seconds, and a table of the middle one and a half."""
    table = tmp_path / "flight.csv"
    table.write_text("time,lat,lon,yaw_deg\n0.5,47,8,90\n2,47,8.003,90\n")
    return film(tmp_path / "flight.mp4", "-c:v", "libx264"), table


@pytest.mark.slow
def test_a_map_of_a_video_has_the_positions_of_its_table(flight, tmp_path, capsys):
    video, table = flight
    path = tmp_path / "valley.gpkg"
    command = ["map", "build", str(path), "--images", str(video), "--technique", "hog", "--rate-hz", "2.5"]
    assert main([*command, "--positions", str(table)]) == 0
    assert "places             8\n" in capsys.readouterr().out
    with PlaceMap.open(path) as place_map:
        placed = [place for place in place_map.places() if place.position]
    assert [round(place.position.lon_deg, 9) for place in placed] == [8.0006, 8.0014, 8.0022, 8.003]
    assert {place.heading_deg for place in placed} == {90.0}
