"""Folders of images and video files, read through open_source."""

import os
import re

import cv2
import numpy as np
import photographs
import pytest
from encoders import Encoder
from numbered_pictures import HEIGHT, WIDTH, draw_picture

from edgevpr.core.errors import SourceError, UsageError
from edgevpr.core.types import Position
from edgevpr.frames.source import open_source, read_intervals, read_to_end

RATE_HZ = 10
SHADES = range(0, 250, 10)  # of the frames of the test video: 2.5 s
PREDICTED_IN_ORDER = {"bf": "0", "sc_threshold": "0"}  # each frame is predicted from the one before


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "ref").mkdir()
    return tmp_path / "ref"


def write_picture(path):
    path.write_bytes(photographs.encode_image(path.suffix, photographs.draw_picture()))


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "flight.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE_HZ, (64, 48))
    for value in SHADES:
        writer.write(np.full((48, 64, 3), value, np.uint8))
    writer.release()
    return path


def read_all_frames(source):
    return list(filter(None, read_to_end(source, pytest.fail)))


def find_shades(frames):
    """Which frames of the test video these are."""
    return [round(frame.image.mean() / 10) for frame in frames]


def test_folder_gives_names_in_utf_8(folder):
    path = os.path.join(os.fsencode(folder), b"caf\xe9.png")
    with open(path, "wb") as file:
        file.write(photographs.encode_image(".png", photographs.draw_picture()))
    (frame,) = read_all_frames(open_source(str(folder), live=False))
    assert frame.name == "caf\\xe9.png"
    (folder / "positions.csv").write_text("file,lat,lon\ncaf\\xe9.png,50,8\n")
    (frame,) = read_all_frames(open_source(str(folder), live=False))
    assert frame.position == Position(50, 8)


def test_folder_gives_each_image_once_in_order(folder):
    for name in ("img10.png", "img9.jpg", "img1.png"):
        write_picture(folder / name)
    source = open_source(str(folder), live=False, clock=lambda: 12.5)
    assert source.total == 3
    assert source.state == "reading"
    frames = read_all_frames(source)
    assert [frame.name for frame in frames] == ["img1.png", "img9.jpg", "img10.png"]
    assert {frame.t_mono_s for frame in frames} == {12.5}
    assert source.state == "ended"
    assert source.read(1.0) is None


def test_positions_come_from_the_csv_and_for_images_it_does_not_name_from_exif(folder):
    pytest.importorskip("PIL", reason="the photographs with EXIF are made with Pillow")
    gps = {1: "N", 2: (50.0, 30.0, 0.0), 3: "E", 4: (14.0, 15.0, 0.0)}
    for name in ("in csv.jpg", "not in csv.jpg", "without.jpg"):
        photographs.write_jpeg(folder / name, gps)
    table = "file,lat,lon,yaw_deg,time,roll_deg,rel_alt\nin csv.jpg,1,2,90,7,-7,80\nwithout.jpg,,,,,,\n"
    (folder.parent / "positions.csv").write_text(table)
    in_csv, not_in_csv, without = read_all_frames(open_source(str(folder), live=False))
    assert (in_csv.position, in_csv.heading_deg, in_csv.t_utc_s) == (Position(1.0, 2.0), 90.0, 7.0)
    assert (in_csv.roll_deg, in_csv.height_m) == (-7.0, 80.0)
    assert not_in_csv.position == Position(50.5, 14.25)
    assert without.position is None


@pytest.mark.parametrize(
    ("times", "steps_s"),
    [
        (("10", "10.5", "10.5", "70"), [0.5, 0.0, 59.5]),
        (("10", "", "11", "12"), []),
        (("10", "11", "10", "12"), []),
        (("10", "10", "10", "10"), []),
    ],
)
def test_recorded_steps_need_a_time_of_each_image_in_order(folder, times, steps_s):
    rows = [f"{number}.jpg,50,8,{time}" for number, time in enumerate(times)]
    (folder / "positions.csv").write_text("\n".join(["file,lat,lon,time", *rows]))
    for number in range(len(times)):
        write_picture(folder / f"{number}.jpg")
    assert read_intervals(str(folder)) == steps_s
    source = open_source(str(folder), live=True, steps_s=steps_s)
    assert [source.step_s for _ in times if source.read(1.0)] == [*steps_s, *[None] * (len(times) - len(steps_s))]


def test_positions_that_do_not_fit_the_source_are_refused(folder, video, tmp_path):
    write_picture(folder / "a.jpg")
    (tmp_path / "other.csv").write_text("file,lat,lon\nb.jpg,3,4\n")
    with pytest.raises(UsageError, match=r"other\.csv"):
        open_source(str(folder), positions=tmp_path / "other.csv", live=False)
    with pytest.raises(UsageError, match=r"other\.csv\b.* 1\b"):
        open_source(str(video), positions=tmp_path / "other.csv", live=False)
    with pytest.raises(UsageError, match=r"other\.csv.*rtsp"):
        open_source("rtsp://127.0.0.1:5/x", positions=tmp_path / "other.csv", live=True)


def test_video_frames_have_the_positions_of_the_table(video, tmp_path):
    table = tmp_path / "flight.csv"
    table.write_text("time,lat,lon,yaw_deg,height_m\n0.5,47,8,350,50\n1.5,47.001,8,10,60\n")
    frames = read_all_frames(open_source(str(video), positions=table, live=False))
    assert len(frames) == len(SHADES)
    placed = [frame for frame in frames if frame.position]
    assert [placed[0].name, placed[-1].name] == ["frame 000005 t=0.500 s", "frame 000015 t=1.500 s"]
    assert placed[5].position.lat_deg == pytest.approx(47.0005)
    assert (placed[5].heading_deg, placed[5].height_m, placed[5].t_utc_s) == (0.0, 55.0, None)
    step = read_all_frames(open_source(str(video), step_s=0.5, positions=table, live=False))
    assert [frame.position for frame in step if frame.position] == [placed[at].position for at in (0, 5, 10)]


@pytest.mark.parametrize("times", [("2026-06-23T16:31:59Z", "2026-06-23T16:32:04Z"), ("-9", "-3")])
def test_positions_of_another_time_than_the_video_are_refused(video, tmp_path, times):
    table = tmp_path / "flight.csv"
    table.write_text("time,lat,lon\n" + "".join(f"{time},47,8\n" for time in times))
    with pytest.raises(UsageError, match=r"0 to 2\.5 s"):
        open_source(str(video), positions=table, live=False)


def test_video_gives_every_frame_to_its_end(video):
    source = open_source(str(video), live=False, clock=lambda: 12.5)
    assert source.total == len(SHADES)
    frames = read_all_frames(source)
    assert find_shades(frames) == list(range(len(SHADES)))
    assert [frame.name for frame in frames[1:3]] == ["frame 000001 t=0.100 s", "frame 000002 t=0.200 s"]
    assert frames[0].t_mono_s == 12.5
    assert (source.state, source.read(1.0)) == ("ended", None)


@pytest.mark.parametrize(("step_s", "stride"), [(0.1, 1), (0.3, 3), (0.25, 3), (1.0, 10), (60.0, 25)])
def test_frames_of_a_video_are_at_least_a_step_apart(step_s, stride, video):
    source = open_source(str(video), step_s=step_s, live=False)
    frames = read_all_frames(source)
    assert find_shades(frames) == list(range(len(SHADES)))[::stride]
    assert abs(source.total - len(frames)) <= 1


def test_open_source_reads_only_the_requested_frames(folder, video):
    for name in ("a.png", "b.png", "c.png"):
        write_picture(folder / name)
    (folder / "d.png").write_bytes(b"no picture, and not asked for")
    source = open_source(str(folder), live=False, only=["c.png", "a.png", "absent.png"])
    assert source.total == 2
    assert [frame.name for frame in read_all_frames(source)] == ["a.png", "c.png"]
    named = ["frame 000003 t=0.300 s", "frame 000007 t=0.700 s"]
    assert [frame.name for frame in read_all_frames(open_source(str(video), live=False, only=named))] == named
    assert read_all_frames(open_source(str(folder), live=False, only=[])) == []


def film(path, codec, options, **container):
    """Film three seconds at 25 Hz, with a key frame every second."""
    encoder = Encoder(str(path), None, codec, 25, (WIDTH, HEIGHT), {"g": "25", **options}, **container)
    for number in range(75):
        encoder.write(number, draw_picture(number))
    encoder.close()
    return path


def read_with_errors(path):
    source, errors = open_source(str(path), live=False), []
    frames = list(filter(None, read_to_end(source, errors.append)))
    return frames, [str(error) for error in errors], source.refused["damaged"], sum(error.count for error in errors)


def read_time(frame):
    return frame.name.split("t=")[1]


def test_video_skips_damaged_frames_and_those_that_depend_on_them(tmp_path):
    path = film(tmp_path / "flight.mkv", "libx264", PREDICTED_IN_ORDER)
    whole, complaints, *_ = read_with_errors(path)
    assert (len(whole), complaints) == (75, [])
    damaged_file = bytearray(path.read_bytes())
    middle = len(damaged_file) // 2
    damaged_file[middle : middle + 300] = np.random.default_rng(1).bytes(300)
    path.write_bytes(damaged_file)
    frames, complaints, damaged, missing = read_with_errors(path)
    images = {read_time(frame): frame.image for frame in whole}
    assert all((images[read_time(frame)] == frame.image).all() for frame in frames)
    assert 50 <= len(frames) < 75
    assert read_time(frames[-1]) == read_time(whole[-1]), "it goes on with the next key frame"
    assert damaged == missing == 75 - len(frames)
    (complaint,) = complaints
    assert f"{path}: frame 0000" in complaint
    assert f" and {damaged - 1} after it" in complaint


def test_video_skips_frames_predicted_from_a_missing_one(tmp_path):
    """Of an MPEG transport stream, recorded from a radio link that lost the packets of a whole frame: no decoder finds
    anything wrong with the frames after it."""
    path = film(tmp_path / "flight.ts", "libx264", PREDICTED_IN_ORDER)
    images = {read_time(frame): frame.image for frame in read_with_errors(path)[0]}
    packets = [path.read_bytes()[start : start + 188] for start in range(0, path.stat().st_size, 188)]
    video = [index for index, packet in enumerate(packets) if packet[1] & 0x1F == 1 and packet[2] == 0]
    begins = [index for index in video if packets[index][1] & 0x40]
    lost = [index for index in video if begins[35] <= index < begins[36]]
    path.write_bytes(b"".join(packet for index, packet in enumerate(packets) if index not in lost))
    frames, complaints, damaged, _ = read_with_errors(path)
    assert all((images[read_time(frame)] == frame.image).all() for frame in frames)
    assert 55 <= len(frames) <= 65
    assert (len(complaints), len(frames) + damaged) == (1, 74)


@pytest.mark.parametrize("name", ["flight.mkv", "flight.avi", "flight.mp4"])
def test_truncated_video_is_reported(name, tmp_path):
    index_first = {"movflags": "faststart"} if name.endswith("mp4") else {}
    path = film(tmp_path / name, "mpeg4", {"qmin": "3", "qmax": "3"}, **index_first)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    frames, complaints, _, missing = read_with_errors(path)
    assert 10 < len(frames) < 60
    assert len(frames) + missing == pytest.approx(75, abs=1)
    assert re.search(rf"{name} is truncated \(1\.[0-9] s of 3\.0 s\)", complaints[-1])


@pytest.mark.parametrize(
    ("name", "content"), [("text.mp4", b"no video" * 100), ("empty.mp4", b""), ("data.bin", bytes(9999))]
)
def test_open_source_refuses_a_file_that_is_not_a_video(name, content, tmp_path, capfd):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SourceError, match=f"{name} .*video"):
        open_source(str(tmp_path / name), live=False)
    assert capfd.readouterr().err == ""


def test_open_source_refuses_a_single_image(tmp_path):
    write_picture(tmp_path / "photo.jpg")
    with pytest.raises(SourceError, match=r"photo\.jpg"):
        open_source(str(tmp_path / "photo.jpg"), live=False)
