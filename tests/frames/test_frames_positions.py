"""positions.csv, right and wrong."""

import os
from contextlib import nullcontext

import pytest

from edgevpr.core.errors import UsageError
from edgevpr.core.types import Position
from edgevpr.frames.positions import (
    GeoTag,
    find_positions,
    list_unread_columns,
    parse_time,
    read_positions,
    read_track,
    write_positions,
)

HEADER = "file,split,lat,lon,alt,rel_alt,yaw_deg,time\n"
FIRST_ROW = "0000.jpg,ref,46.84260708,-91.99455989,198.309,39.8,46.0,2016:06:23 16:31:59\n"


@pytest.fixture
def write_table(tmp_path):
    def write(text, encoding="utf-8"):
        (tmp_path / "positions.csv").write_bytes(text.encode(encoding))
        return tmp_path / "positions.csv"

    return write


@pytest.mark.parametrize(
    ("text", "tags"),
    [
        (
            HEADER + FIRST_ROW,
            {
                "0000.jpg": GeoTag(
                    position=Position(46.84260708, -91.99455989, 198.309),
                    heading_deg=46.0,
                    t_utc_s=1466699519.0,
                    height_m=39.8,
                )
            },
        ),
        (HEADER + "a.jpg,ref,,,,,,\n", {"a.jpg": GeoTag()}),
        # a receiver without a fix, and one that has it
        ("file,lat,lon\na.jpg,0,0.0\nb.jpg,0,0.1\n", {"a.jpg": GeoTag(), "b.jpg": GeoTag(position=Position(0.0, 0.1))}),
        (
            'File, Lat, Lon\r\n"a, b.jpg", 1.5, 2\r\n\r\nc.jpg,3,4\r\n',  # as spreadsheets write
            {"a, b.jpg": GeoTag(position=Position(1.5, 2.0)), "c.jpg": GeoTag(position=Position(3.0, 4.0))},
        ),
        (
            "file,lat,lon,heading_deg,yaw_deg\na.jpg,,,-90,5\nb.jpg,,,,360\nc.jpg,,,,-180\n",
            {"a.jpg": GeoTag(heading_deg=270), "b.jpg": GeoTag(heading_deg=0), "c.jpg": GeoTag(heading_deg=180)},
        ),
        (  # the height over the take-off point stands in
            "file,lat,lon,roll_deg,pitch_deg,height_m,rel_alt\na.jpg,,,-12.5,3,80,90\nb.jpg,,,,,,90\n",
            {"a.jpg": GeoTag(roll_deg=-12.5, pitch_deg=3.0, height_m=80.0), "b.jpg": GeoTag(height_m=90.0)},
        ),
    ],
)
def test_read_positions_reads_each_column(text, tags, write_table):
    assert read_positions(write_table(text, "utf-8-sig")) == tags


@pytest.mark.parametrize(
    "text",
    [
        "2016:06:23 16:31:59",
        "2016-06-23 16:31:59",
        "2016-06-23T16:31:59Z",
        "2016-06-23T18:31:59+02:00",
        "2016:06:23 18:31:59+02:00",
        "1466699519",
        "1466699519.0",
    ],
)
def test_parse_time_reads_each_format(text):
    assert parse_time(text) == 1466699519


@pytest.mark.parametrize(
    "text",
    ["", "yesterday", "nan", "-inf", "2016:13:23 16:31:59", "2016:06:23 25:00:00", "1466699519000", "1e308", "-1e10"],
)
def test_parse_time_refuses_other_text(text):
    with pytest.raises(ValueError):
        parse_time(text)


@pytest.mark.parametrize(
    "columns", ["lat,lat_ref,lon,lon_ref", "lat,GPSLatitudeRef,lon,GPSLongitudeRef", "lat,lat_ns,lon,lon_ew"]
)
@pytest.mark.parametrize(
    ("cells", "is_accepted"),
    [("46.8,S,91.9,W", False), ("46.8,N,91.9,West", False), ("-46.8,S,-91.9,W", True), ("46.8,N,91.9,E", True)],
)
def test_read_positions_refuses_signs_in_separate_columns(columns, cells, is_accepted, write_table):
    path = write_table(f"file,{columns}\na.jpg,{cells}\n")
    with nullcontext() if is_accepted else pytest.raises(UsageError, match=r"line 2: .* south and west as negative"):
        read_positions(path)


def test_list_unread_columns_names_only_those_that_look_like_ones_of_ours(write_table):
    columns = "pitch,Height (ft),gimbal_pitch_deg,yaw_deg,platform,relative_time,image_height"
    path = write_table(f"file,lat,lon,{columns}\na.jpg,46,8,-45,130,-45,10,p,3,480\n")
    assert list_unread_columns(path) == ["pitch", "height (ft)", "gimbal_pitch_deg"]


@pytest.mark.parametrize(
    ("row", "complaint"),
    [
        ("b.jpg,ref,north,2,,,,", "line 3: lat is `north`.* -90 to 90"),
        ("b.jpg,ref,nan,2,,,,", "line 3: lat is `nan`"),
        ("b.jpg,ref,46,-181,,,,", "line 3: lon is `-181`.* -180 to 180"),
        ("b.jpg,ref,46,2,,low,,", "line 3: rel_alt is `low`.* -1000 to 100000"),
        ("b.jpg,ref,46,2,,,,noon", "line 3: time is `noon`"),
        ("b.jpg,ref,46,2,,,,1466699519000", "line 3: time is `1466699519000`.* 2016-06-23"),  # ms
        ("b.jpg,ref,46,2,,,,0001-01-01T00:00:00+14:00", "line 3: time is"),
        ("b.jpg,ref,46,,,,,", "line 3 .* lat and lon"),
        ("b.jpg,46,2", "line 3 .* values"),
        ("b.jpg,ref,46,84,2,0,,,,", "line 3 .* values"),
        (",ref,46,2,,,,", "line 3: `file` is ``"),
        ("0000.jpg,ref,46,2,,,,", "`file` is `0000.jpg`"),
    ],
)
def test_read_positions_names_line_and_value_of_a_wrong_row(row, complaint, write_table):
    path = write_table(HEADER + FIRST_ROW + row + "\n")
    with pytest.raises(UsageError, match=complaint) as refusal:
        read_positions(path)
    assert str(refusal.value).startswith(str(path))


@pytest.mark.parametrize(
    ("text", "column"),
    [
        ("", "file"),
        ("file;lat;lon\n", "file"),
        ("file,lat,lng\n", "lon"),
        ("file,lat,lon, LAT\n", "lat"),
        ("file,lat,lon,time,Time\n", "time"),
        ("file,lat,lon,rel_alt,rel_alt\n", "rel_alt"),
    ],
)
def test_read_positions_names_a_missing_or_duplicate_column(text, column, write_table):
    with pytest.raises(UsageError, match=f"line 1.*`{column}`"):
        read_positions(write_table(text))
    assert read_positions(write_table("file,lat,lon,note,note\na.jpg,,,,\n")) == {"a.jpg": GeoTag()}


def test_read_positions_refuses_binary_files(write_table, tmp_path):
    with pytest.raises(UsageError, match=r"nothing\.csv"):
        read_positions(tmp_path / "nothing.csv")
    with pytest.raises(UsageError, match="text file"):
        read_positions(write_table("file,lat,lon\nö.jpg,1,2\n", "latin-1"))
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(UsageError, match="pipe"):
        read_positions(tmp_path / "pipe.csv")


def test_find_positions_in_the_folder_or_next_to_it(tmp_path, monkeypatch):
    folder = tmp_path / "ref"
    folder.mkdir()
    assert find_positions(folder) is None
    (tmp_path / "positions.csv").touch()
    assert find_positions(folder) == tmp_path / "positions.csv"
    monkeypatch.chdir(folder)
    assert find_positions(".") == tmp_path / "positions.csv"
    (folder / "positions.csv").touch()
    assert find_positions(folder) == folder / "positions.csv"


def test_write_positions_is_read_as_the_same(tmp_path):
    at = Position(-35.123456789012345, 179.99999999999997, 612.3000000000001)
    tags = {"a.png": GeoTag(position=at, heading_deg=0.1, roll_deg=-0.2, pitch_deg=1 / 3, height_m=80.0, t_utc_s=7.5)}
    tags |= {"b, c.png": GeoTag(position=Position(1.0, 2.0)), "d.png": GeoTag()}
    write_positions(tmp_path / "positions.csv", tags)
    assert read_positions(tmp_path / "positions.csv") == tags


@pytest.fixture
def track(write_table):
    """A function that writes a table and reads it."""
    return lambda text: read_track(write_table(text))


def test_interpolate_tag_rotates_headings_the_shorter_way(track):
    rows = "10,50,179.999,600,350,-4,2,80\n12,51,-179.999,604,20,4,,90\n"
    found = track(f"time,lat,lon,alt,yaw_deg,roll_deg,pitch_deg,rel_alt\n{rows}")
    half = found.interpolate_tag(11.0)
    assert half.position.lat_deg == 50.5
    assert abs(half.position.lon_deg) == pytest.approx(180)
    assert half.position.alt_m == 602
    assert (half.heading_deg, half.roll_deg, half.pitch_deg, half.height_m) == (5.0, 0.0, None, 85.0)
    assert found.interpolate_tag(10.5).heading_deg == 357.5
    assert found.interpolate_tag(11.5).position.lon_deg == pytest.approx(-179.9995)


def test_interpolate_tag_is_none_outside_the_table_and_in_wide_gaps(track):
    found = track("time,lat,lon\n1,50,8\n2,,\n6,50.1,8\n11.1,50.2,8\n12,0,0\n13,50.3,8\n")
    assert [found.interpolate_tag(t_s).position is not None for t_s in (0.9, 1, 3, 6, 8, 11.1, 12, 13, 13.1)] == [
        False, True, True, True, False, True, True, True, False
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("file,lat,lon\na.jpg,1,2\n", "`time`"),
        ("time,lat,lon\n2,2,3\n1,2,3\n", "line 3: time must"),
        ("time,lat,lon\n,2,3\n", "line 2: time must"),
        ("time,lat,lon\nsoon,2,3\n", "line 2: time is `soon`"),
        ("time,lat,lon\n1,,\n2,0,0\n", "no line"),
    ],
)
def test_read_track_refuses_a_table_without_a_path(track, text, said):
    with pytest.raises(UsageError, match=said):
        track(text)
