"""The positions of a video: on the lines of its table, between them, and where it says nothing."""

import pytest

from edgevpr.core.errors import UsageError
from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, read_track


@pytest.fixture
def track(tmp_path):
    """A function that writes a table and reads it."""

    def made(text):
        (tmp_path / "flight.csv").write_text(text)
        return read_track(tmp_path / "flight.csv")

    return made


def test_a_frame_lies_between_two_lines_and_turns_the_shorter_way(track):
    found = track(
        "time,lat,lon,alt,yaw_deg,roll_deg,pitch_deg,rel_alt\n10,50,179.999,600,350,-4,2,80\n12,51,-179.999,604,20,4,,90\n"
    )
    half = found.tag_at(11.0)
    assert half.position.lat_deg == 50.5
    assert abs(half.position.lon_deg) == pytest.approx(180)
    assert half.position.alt_m == 602
    assert (half.heading_deg, half.roll_deg, half.pitch_deg, half.height_m) == (5.0, 0.0, None, 85.0)
    assert found.tag_at(10.5).heading_deg == 357.5
    assert found.tag_at(11.5).position.lon_deg == pytest.approx(-179.9995)


def test_on_a_line_the_tag_is_that_of_the_line_to_the_last_bit(track):
    found = track("time,lat,lon,yaw_deg,file\n-3,1.1,2.2,,\n0.3333,50.123456789,8.7,350,a.jpg\n")
    tag = GeoTag(position=Position(50.123456789, 8.7), heading_deg=350.0)
    assert found.tag_at(0.3333) == found.tag_at(0.333) == tag, "Matroska rounds to milliseconds"


def test_nothing_is_made_up_outside_the_table_and_in_wide_gaps(track):
    found = track("time,lat,lon\n1,50,8\n2,,\n6,50.1,8\n11.1,50.2,8\n12,0,0\n13,50.3,8\n")
    assert [found.tag_at(t_s).position is not None for t_s in (0.9, 1, 3, 6, 8, 11.1, 12, 13, 13.1)] == [
        False, True, True, True, False, True, True, True, False
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("file,lat,lon\na.jpg,1,2\n", "line 1 has no column `time`: it must name time, lat, lon"),
        ("time,lat,lon\n1,2,3\n1,2,3\n", "line 3: time is not after that of the line before"),
        ("time,lat,lon\n2,2,3\n1,2,3\n", "line 3: time is not after that of the line before"),
        ("time,lat,lon\n,2,3\n", "line 2 has no time: write the seconds from the first frame"),
        ("time,lat,lon\nsoon,2,3\n", "line 2: time is `soon`"),
        ("time,lat,lon\n1,,\n2,0,0\n", "has no line with time, lat and lon"),
        ("", "line 1 has no column `time`"),
    ],
)
def test_a_table_that_says_no_path_is_refused(track, text, said):
    with pytest.raises(UsageError, match=said):
        track(text)
