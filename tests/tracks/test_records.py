"""Reading what recordings say: each format, whole and damaged, and what a reader makes of it."""

import struct
from contextlib import nullcontext

import pytest
from recordings import START_S, write_dataflash, write_gpx, write_tlog, write_ulog

from edgevpr.core.errors import UsageError
from edgevpr.tracks.placing import place_pictures
from edgevpr.tracks.record import read_record

# seconds, lat, lon, alt, height, roll, pitch, yaw
POINTS = [(t, -35.36 + 1e-4 * t, 149.16 + 2e-4 * t, 600.0 + t, 20.0 + t, 5.0, -3.0, 280.0) for t in range(6)]
SHOTS = [(t + 0.5, -35.5 + 1e-4 * t, 149.5, 610.0, 30.0, 1.0, 2.0, 90.0) for t in range(3)]


def require_tag(tag, point, of_height=True):
    _, lat, lon, alt, height, roll, pitch, yaw = point
    assert (tag.position.lat_deg, tag.position.lon_deg) == pytest.approx((lat, lon), abs=1e-6)
    assert tag.position.alt_m == pytest.approx(alt, abs=0.1)
    assert (tag.roll_deg, tag.pitch_deg, tag.heading_deg) == pytest.approx((roll, pitch, yaw), abs=0.02)
    assert tag.height_m == (pytest.approx(height, abs=0.1) if of_height else None)


@pytest.mark.parametrize(("ending", "write"), [(".bin", write_dataflash), (".tlog", write_tlog)])
def test_read_record_reads_track_and_camera_messages_of_a_log(tmp_path, ending, write):
    path = tmp_path / f"flight{ending}"
    write(path, POINTS, SHOTS)
    record = read_record(path)
    assert record.is_utc
    assert record.track.t_s == pytest.approx([START_S + t for t in range(6)], abs=0.01)
    for tag, point in zip(record.track.tags, POINTS, strict=True):
        require_tag(tag, point)
    for tag, shot in zip(record.shots, SHOTS, strict=True):
        require_tag(tag, shot)


@pytest.mark.parametrize(("ending", "write"), [(".bin", write_dataflash), (".tlog", write_tlog)])
def test_read_record_reads_a_truncated_log_without_output(tmp_path, capfd, ending, write):
    path = tmp_path / f"flight{ending}"
    write(path, POINTS)
    path.write_bytes(path.read_bytes()[:-30] + b"\x00" * 600)
    assert 4 <= len(read_record(path).track.t_s) <= 6
    assert capfd.readouterr() == ("", "")


def px4_log(position="vehicle_global_position"):
    stamps = [int(1e6 * (7 + t)) for t in range(6)]
    north = (1.0, 0.0, 0.0, 0.0)
    where = {"timestamp": "uint64_t", "lat": "double", "lon": "double", "alt": "float"}
    receiver = {"timestamp": "uint64_t", "time_utc_usec": "uint64_t", "fix_type": "uint8_t"}
    receiver |= dict.fromkeys(("lat", "lon", "alt"), "int32_t")
    told = [(at, int(1e6 * (START_S + t)), 3, 471234567, 85551234, 450000) for t, at in enumerate(stamps)]
    topics = {
        "vehicle_gps_position": (receiver, told),
        "vehicle_attitude": ({"timestamp": "uint64_t", "q": "float[4]"}, [(at, north) for at in stamps]),
        "vehicle_local_position": ({"timestamp": "uint64_t", "z": "float"}, [(at, -40.0) for at in stamps]),
    }
    if position:
        topics[position] = (where, [(at, 47.5 + 1e-4 * t, 8.5, 500.0) for t, at in enumerate(stamps)])
    return topics


def test_read_record_reads_the_time_of_a_px4_log_from_its_receiver(tmp_path):
    write_ulog(tmp_path / "flight.ulg", px4_log() | {"camera_capture": px4_log("camera_capture")["camera_capture"]})
    record = read_record(tmp_path / "flight.ulg")
    assert record.track.t_s == pytest.approx([START_S + t for t in range(6)], abs=0.01)
    assert len(record.shots) == 6
    for tag in (*record.track.tags, *record.shots):
        assert (tag.heading_deg, tag.roll_deg, tag.pitch_deg) == pytest.approx((0, 0, 0), abs=1e-6)
        assert tag.height_m == pytest.approx(40)
        assert tag.position.lon_deg == pytest.approx(8.5)


def test_read_record_requires_times_in_a_gpx_track(tmp_path):
    path = tmp_path / "walk.gpx"
    write_gpx(path, [(t, 50 + 1e-4 * t, 8) for t in range(4)])
    record = read_record(path)
    assert record.track.t_s == tuple(START_S + t for t in range(4))
    assert record.track.tags[3].position.lat_deg == pytest.approx(50.0003)
    path.write_text(path.read_text().replace("<time>", "<name>").replace("</time>", "</name>"))
    with pytest.raises(UsageError, match="times"):
        read_record(path)


# Each form with the altitude, height and (heading, roll, pitch) that it says.
SUBTITLES = {
    "phantom": ("HOME(8.5,50.1) 2017.08.05 14:11:51\nGPS(8.5,50.2,16) BAROMETER:1.9\nISO:100", None, 1.9, None),
    "old": ("HOME(8.5,50.1) 2017.8.5 14:11:51\nGPS(8.5,50.2,16) Hb:2.9 Hs:1.9", None, 2.9, None),
    "matrice": ("2022.06.21 16:06:17\nGPS(50.2,8.5,310.0M) BAROMETER:0.3M", None, 0.3, None),
    "mini": ("F/2.8, SS 30, GPS (8.5000, 50.2000, 17), D 221.21m, H 200.70m, H.S n/a", None, 200.7, None),
    "rtk": (
        "GPS (8.5, 50.2, 15), HOME (8.4, 50.1, -57.98m), D 698.70m, H 85.80m, H.S 0.00m/s, "
        "F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-90.0°, 0.0°, -70.0°)",
        *(None, 85.8, (290.0, 0.0, 0.0)),
    ),
    "mavic 2": ("[latitude : 50.2] [longtitude : 8.5] [altitude: 213.9] </font>", 213.9, None, None),
    "mavic 3": ("[latitude: 50.2] [longitude: 8.5] [rel_alt: -2.4 abs_alt: 130.4] </font>", 130.4, -2.4, None),
    "enterprise": (
        "[latitude: 50.2] [longtitude: 8.5] [rel_alt: 4.1 abs_alt: 485.4] [Drone: Yaw:-17.9, Pitch:-1.4, Roll:1.1]",
        *(485.4, 4.1, (342.1, None, None)),
    ),
    "thermal": (
        "[latitude: 50.2] [longitude: 8.5] [rel_alt: 80.5 abs_alt: 327.0]\n[drone_yaw: 10.0 drone_roll: 2.0]\n"
        "[gb_yaw: -100.0 gb_pitch: -80.0 gb_roll: 0.0]",
        *(327.0, 80.5, (260.0, 0.0, 10.0)),
    ),
}


@pytest.mark.parametrize("form", SUBTITLES)
def test_read_record_reads_each_subtitle_format(tmp_path, form):
    block, alt_m, height_m, turned = SUBTITLES[form]
    text = "".join(f"{at + 1}\n00:00:{at:02},500 --> 00:00:{at + 1:02},500\n{block}\n\n" for at in range(3))
    (tmp_path / "film.SRT").write_text("\ufeff" + text)
    record = read_record(tmp_path / "film.SRT")
    assert not record.is_utc
    assert record.track.t_s == (0.5, 1.5, 2.5)
    tag = record.track.tags[0]
    assert (tag.position.lat_deg, tag.position.lon_deg) == (50.2, 8.5)
    assert (tag.position.alt_m, tag.height_m) == (alt_m, height_m)
    told = (tag.heading_deg, tag.roll_deg, tag.pitch_deg)
    assert told == (pytest.approx(turned, abs=1e-6) if turned and turned[1] is not None else turned or (None,) * 3)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("imagename;latitude;longitude;altitude\nC:\\f\\a.JPG;50,25;8,5;120\n", (50.25, 8.5, 120)),
        ("SourceFile,GPSLatitude,GPSLongitude\n./f/a.JPG,\"50 deg 15' 0.00\"\" S\",\"8 deg 30' 0.00\"\" W\"\n",
         (-50.25, -8.5, None)),
        ("#Label,X/Longitude,Y/Latitude,Z/Altitude\na.JPG,8.5,50.25,120\n", (50.25, 8.5, 120)),
        ("EPSG:4326\na.JPG 8.5 50.25 120\n", (50.25, 8.5, 120)),
        ("a.JPG,50.25,8.5,120\nb.JPG,50.26,8.5,120\n", (50.25, 8.5, 120)),
        ("SourceFile,GPSLatitude,GPSLatitudeRef,GPSLongitude,GPSLongitudeRef\na.JPG,50.25,S,8.5,W\n",
         (-50.25, -8.5, None)),
        ("SourceFile,EXIF:GPSLatitudeRef,EXIF:GPSLatitude,EXIF:GPSLongitudeRef,EXIF:GPSLongitude\n"
         "a.JPG,South,50.25,West,8.5\n", (-50.25, -8.5, None)),
        ("SourceFile,GPS:GPSLatitude,GPS:GPSLongitude,Composite:GPSLatitude,Composite:GPSLongitude\n"
         "a.JPG,50,8,-50.25,-8.5\n", (-50.25, -8.5, None)),
        ("\ufefffile\tVehicle Latitude [deg]\tVehicle Longitude [deg]\na.JPG\t50.25 N\t8.5 E\n", (50.25, 8.5, None)),
    ],
)  # fmt: skip
def test_read_record_reads_tables_of_other_programs(tmp_path, text, expected):
    (tmp_path / "table.csv").write_text(text)
    record = read_record(tmp_path / "table.csv")
    at = record.tags_by_name["a.JPG"].position
    assert (at.lat_deg, at.lon_deg, at.alt_m) == expected
    assert "separated by" in record.kind


@pytest.mark.parametrize(
    ("columns", "cells", "expected", "unused"),
    [
        ("yaw_deg,roll_deg,pitch_deg", "10,2,-3", (10, 2, -3), None),
        ("GimbalYawDegree,GimbalPitchDegree", "10,-45", (10, 0, 45), None),
        ("GPSImgDirectionRef,GPSImgDirection", "M,10", (None,) * 3, None),
        (
            "GPSImgDirectionRef,GPSImgDirection,yaw_deg",
            "M,10,20",
            (20, None, None),
            "`GPSImgDirectionRef`, `GPSImgDirection`",
        ),
        ("ExifImageHeight,RollingShutter,FlightYawDegree", "9,1,20", (20, None, None), None),
        ("GPSImgDirectionRef,GPSImgDirection", "T,10", (10, None, None), None),
        ("yaw,pitch,roll", "10,-45,0", (10, None, None), "`pitch`, `roll`"),
    ],
)
def test_read_record_says_which_angles_of_a_table_it_does_not_read(tmp_path, columns, cells, expected, unused):
    (tmp_path / "table.csv").write_text(f"file,lat,lon,{columns}\na.JPG,50,8,{cells}\n")
    record = read_record(tmp_path / "table.csv")
    tag = record.tags_by_name["a.JPG"]
    assert (tag.heading_deg, tag.roll_deg, tag.pitch_deg) == pytest.approx(expected, abs=1e-6)
    assert record.kind.endswith(f"; not used: {unused}" if unused else "commas")


@pytest.mark.parametrize(("lat_deg", "is_accepted"), [(50.25, True), (50.26, False)])
def test_read_record_refuses_two_positions_for_a_name(tmp_path, lat_deg, is_accepted):
    text = f"SourceFile,GPSLatitude,GPSLongitude\nf/a.JPG,50.25,8.5\nf/a.JPG,{lat_deg},8.5\n"
    (tmp_path / "table.csv").write_text(text)
    with nullcontext() if is_accepted else pytest.raises(UsageError, match=r"two different rows for `a\.JPG`"):
        assert read_record(tmp_path / "table.csv").tags_by_name.keys() == {"a.JPG"}


def test_place_pictures_goes_by_the_folder_where_names_repeat(tmp_path):
    rows = "DCIM/100MEDIA/a.JPG,50,8\nDCIM/101MEDIA/a.JPG,51,8\nDCIM/b.JPG,52,8\n"
    (tmp_path / "table.csv").write_text(f"SourceFile,GPSLatitude,GPSLongitude\n{rows}")
    record = read_record(tmp_path / "table.csv")
    for folder, lat_deg in (("100MEDIA", 50), ("101MEDIA", 51)):
        (tmp_path / folder).mkdir()
        for name in ("a.jpg", "b.tif"):
            (tmp_path / folder / name).touch()
        tags = place_pictures(record, tmp_path / folder, None).tags
        assert [tag.position.lat_deg for tag in tags.values()] == [lat_deg, 52]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "a.jpg").touch()
    with pytest.raises(UsageError, match="lists none of the images"):
        place_pictures(record, tmp_path / "other", None)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("t.csv", b"file,x,y\na.jpg,1,2\n", "line 1"),
        ("t.csv", b"WGS84 UTM 32N\na.jpg 500000 5500000 3\n", "WGS 84"),
        ("t.csv", b"EPSG:32632\na.jpg 1 2 3\n", "WGS 84"),
        ("t.csv", b"file,lat,lon\na.jpg,here,8\n", "is invalid"),
        ("t.csv", b"file,lat,lon\na.jpg,150,200\n", "swapped"),
        ("t.csv", b"file,lat,lon,height (ft)\na.jpg,50,8,130\n", "metres"),
        ("t.csv", b"file,lat,lon,yaw (rad)\na.jpg,50,8,0.8\n", "degrees"),
        ("t.csv", bytes(range(256)), "UTF-8"),
        ("t.bin", b"", "log"),
        ("t.bin", struct.pack("64x"), "no position"),
        ("t.log", b"nothing\n", "no position"),
        ("t.tlog", b"\x00" * 100, "no position"),
        ("t.ulg", b"ULo", "PX4"),
        ("t.srt", b"", "no position"),
        ("t.srt", b"1\n00:00:01,000 --> 00:00:02,000\n[latitude: 0.0] [longitude: 0.0]\n", "no position"),
        ("t.gpx", b"<gpx", "GPX"),
    ],
)
def test_read_record_refuses_other_files_in_one_sentence(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UsageError, match=said):
        read_record(tmp_path / name)
    with pytest.raises(UsageError, match=r"nothing\.bin"):
        read_record(tmp_path / "nothing.bin")
