"""Folders of images and video files, read through open_source."""

import os
import re

import cv2
import numpy as np
import photographs
import pytest
from films import cut_in_half, film, overwrite_in_the_middle

from edgevpr.core.errors import ImageError, SourceError, UsageError
from edgevpr.core.types import Position
from edgevpr.frames.source import open_source, recorded_steps

RATE_HZ = 10
SHADES = range(0, 250, 10)  # of the frames of the test video: 2.5 s


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "ref").mkdir()
    return tmp_path / "ref"


def write_picture(path):
    path.write_bytes(photographs.encoded(path.suffix, photographs.picture()))


def shade(value):
    return np.full((48, 64, 3), value, np.uint8)


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "flight.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE_HZ, (64, 48))
    for value in SHADES:
        writer.write(shade(value))
    writer.release()
    return path


def all_frames(source):
    frames = []
    while not source.ended:
        frame = source.read(1.0)
        if frame:
            frames.append(frame)
    source.close()
    return frames


def shades_of(frames):
    """Which frames of the test video these are."""
    return [round(frame.image.mean() / 10) for frame in frames]


def test_an_image_whose_name_is_not_utf_8_has_a_name_that_a_map_can_hold(folder):
    path = os.path.join(os.fsencode(folder), b"caf\xe9.png")
    with open(path, "wb") as file:
        file.write(photographs.encoded(".png", photographs.picture()))
    (frame,) = all_frames(open_source(str(folder), live=False))
    assert frame.name == "caf\\xe9.png"
    (folder / "positions.csv").write_text("file,lat,lon\ncaf\\xe9.png,50,8\n")
    (frame,) = all_frames(open_source(str(folder), live=False))
    assert frame.position == Position(50, 8)


def test_a_folder_gives_each_image_once_in_order(folder):
    for name in ("img10.png", "img9.jpg", "img1.png"):
        write_picture(folder / name)
    source = open_source(str(folder), live=False, clock=lambda: 12.5)
    assert source.total == 3
    assert source.state == "reading"
    frames = all_frames(source)
    assert [frame.name for frame in frames] == ["img1.png", "img9.jpg", "img10.png"]
    assert {frame.t_mono_s for frame in frames} == {12.5}
    assert source.state == "ended"
    assert source.read(1.0) is None


def test_a_bad_image_is_said_once_and_the_next_one_follows(folder):
    write_picture(folder / "1.jpg")
    (folder / "2.jpg").write_bytes((folder / "1.jpg").read_bytes()[:-200])
    write_picture(folder / "3.jpg")
    source = open_source(str(folder), live=False)
    assert source.read(1.0).name == "1.jpg"
    with pytest.raises(ImageError, match=r"2\.jpg"):
        source.read(1.0)
    assert source.read(1.0).name == "3.jpg"
    assert source.ended


def test_positions_come_from_the_csv_and_for_images_it_does_not_name_from_exif(folder):
    pytest.importorskip("PIL", reason="the photographs with EXIF are made with Pillow")
    gps = {1: "N", 2: (50.0, 30.0, 0.0), 3: "E", 4: (14.0, 15.0, 0.0)}
    for name in ("in csv.jpg", "not in csv.jpg", "without.jpg"):
        photographs.write_jpeg(folder / name, gps)
    (folder.parent / "positions.csv").write_text(
        "file,lat,lon,yaw_deg,time,roll_deg,rel_alt\nin csv.jpg,1,2,90,7,-7,80\nwithout.jpg,,,,,,\n"
    )
    in_csv, not_in_csv, without = all_frames(open_source(str(folder), live=False))
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
def test_a_folder_tells_the_steps_of_its_times_where_all_have_one_in_order(folder, times, steps_s):
    rows = [f"{number}.jpg,50,8,{time}" for number, time in enumerate(times)]
    (folder / "positions.csv").write_text("\n".join(["file,lat,lon,time", *rows]))
    for number in range(len(times)):
        write_picture(folder / f"{number}.jpg")
    assert recorded_steps(str(folder)) == steps_s
    source = open_source(str(folder), live=True, steps_s=steps_s)
    told = [source.step_s for _ in times if source.read(1.0)]
    assert told == [*steps_s, *[None] * (len(times) - len(steps_s))]


def test_positions_that_cannot_be_meant_for_the_source_are_refused(folder, video, tmp_path):
    write_picture(folder / "a.jpg")
    (tmp_path / "other.csv").write_text("file,lat,lon\nb.jpg,3,4\n")
    with pytest.raises(UsageError, match=r"other\.csv"):
        open_source(str(folder), positions=tmp_path / "other.csv", live=False)
    with pytest.raises(UsageError, match=r"other\.csv, line 1"):
        open_source(str(video), positions=tmp_path / "other.csv", live=False)
    with pytest.raises(UsageError, match=r"other\.csv.*rtsp"):
        open_source("rtsp://127.0.0.1:5/x", positions=tmp_path / "other.csv", live=True)


def test_frames_of_a_video_lie_where_the_table_says_between_its_lines(video, tmp_path):
    table = tmp_path / "flight.csv"
    table.write_text("time,lat,lon,yaw_deg,height_m\n0.5,47,8,350,50\n1.5,47.001,8,10,60\n")
    frames = all_frames(open_source(str(video), positions=table, live=False))
    assert len(frames) == len(SHADES)
    placed = [frame for frame in frames if frame.position]
    assert [placed[0].name, placed[-1].name] == ["frame 000005 t=0.500 s", "frame 000015 t=1.500 s"]
    assert placed[5].position.lat_deg == pytest.approx(47.0005)
    assert (placed[5].heading_deg, placed[5].height_m, placed[5].t_utc_s) == (0.0, 55.0, None)
    step = all_frames(open_source(str(video), step_s=0.5, positions=table, live=False))
    assert [frame.position for frame in step if frame.position] == [placed[at].position for at in (0, 5, 10)]


@pytest.mark.parametrize("times", [("2026-06-23T16:31:59Z", "2026-06-23T16:32:04Z"), ("-9", "-3")])
def test_positions_of_another_time_than_the_video_are_refused(video, tmp_path, times):
    table = tmp_path / "flight.csv"
    table.write_text("time,lat,lon\n" + "".join(f"{time},47,8\n" for time in times))
    with pytest.raises(UsageError, match=r"0 to 2\.5 s"):
        open_source(str(video), positions=table, live=False)


def test_a_video_gives_every_frame_to_its_end(video):
    source = open_source(str(video), live=False, clock=lambda: 12.5)
    assert source.total == len(SHADES)
    frames = all_frames(source)
    assert shades_of(frames) == list(range(len(SHADES)))
    assert [frame.name for frame in frames[:3]] == [
        "frame 000000 t=0.000 s",
        "frame 000001 t=0.100 s",
        "frame 000002 t=0.200 s",
    ]
    assert frames[0].t_mono_s == 12.5
    assert (source.state, source.read(1.0)) == ("ended", None)


@pytest.mark.parametrize(("step_s", "stride"), [(0.1, 1), (0.3, 3), (0.25, 3), (1.0, 10), (60.0, 25)])
def test_frames_of_a_video_are_at_least_a_step_apart(step_s, stride, video):
    source = open_source(str(video), step_s=step_s, live=False)
    frames = all_frames(source)
    assert shades_of(frames) == list(range(len(SHADES)))[::stride]
    assert abs(source.total - len(frames)) <= 1


def test_of_a_recording_only_the_frames_that_are_asked_for_are_read(folder, video):
    for name in ("a.png", "b.png", "c.png"):
        write_picture(folder / name)
    (folder / "d.png").write_bytes(b"no picture, and not asked for")
    source = open_source(str(folder), live=False, only=["c.png", "a.png", "absent.png"])
    assert source.total == 2
    assert [frame.name for frame in all_frames(source)] == ["a.png", "c.png"]
    named = ["frame 000003 t=0.300 s", "frame 000007 t=0.700 s"]
    frames = all_frames(open_source(str(video), live=False, only=named))
    assert [frame.name for frame in frames] == named
    assert shades_of(frames) == [3, 7]
    assert all_frames(open_source(str(folder), live=False, only=[])) == []


def frames_and_complaints(path):
    source, frames, complaints, missing = open_source(str(path), live=False), [], [], 0
    while not source.ended:
        try:
            frames.append(source.read(9.0))
        except ImageError as error:
            complaints.append(str(error))
            missing += error.count
    source.close()
    return [frame for frame in frames if frame], complaints, source.refused["damaged"], missing


def time_of(frame):
    return frame.name.split("t=")[1]


@pytest.fixture
def films(tmp_path):
    """A function that makes a film of this name."""
    return lambda name, *coding: film(tmp_path / name, *coding)


@pytest.mark.process
def test_damaged_frames_of_a_video_and_those_built_on_them_are_left_out_counted_and_said_once(films):
    path = films("flight.mkv", "-c:v", "libx264", "-bf", "0", "-sc_threshold", "0")
    whole, complaints, *_ = frames_and_complaints(path)
    assert (len(whole), complaints) == (75, [])
    overwrite_in_the_middle(path)
    frames, complaints, damaged, missing = frames_and_complaints(path)
    images = {time_of(frame): frame.image for frame in whole}
    assert all((images[time_of(frame)] == frame.image).all() for frame in frames)
    assert 50 <= len(frames) < 75
    assert time_of(frames[-1]) == time_of(whole[-1]), "it goes on with the next key frame"
    assert damaged == missing == 75 - len(frames)
    (complaint,) = complaints
    assert f"{path}: frame 0000" in complaint
    assert "being damaged or built on damage: copy the video again." in complaint


@pytest.mark.process
def test_frames_predicted_from_one_that_is_missing_are_left_out(films):
    """Of an MPEG transport stream, recorded from a radio link that lost the packets of a whole frame: no decoder finds
    anything wrong with the frames after it."""
    path = films("flight.ts", "-c:v", "libx264", "-bf", "0", "-sc_threshold", "0")
    images = {time_of(frame): frame.image for frame in frames_and_complaints(path)[0]}
    packets = [path.read_bytes()[start : start + 188] for start in range(0, path.stat().st_size, 188)]
    video = [index for index, packet in enumerate(packets) if packet[1] & 0x1F == 1 and packet[2] == 0]
    begins = [index for index in video if packets[index][1] & 0x40]
    lost = [index for index in video if begins[35] <= index < begins[36]]
    path.write_bytes(b"".join(packet for index, packet in enumerate(packets) if index not in lost))
    frames, complaints, damaged, _ = frames_and_complaints(path)
    assert all((images[time_of(frame)] == frame.image).all() for frame in frames)
    assert 55 <= len(frames) <= 65
    assert (len(complaints), len(frames) + damaged) == (1, 74)


@pytest.mark.process
@pytest.mark.parametrize("name", ["flight.mkv", "flight.avi", "flight.mp4"])
def test_a_video_that_is_cut_short_is_said(name, films):
    path = films(
        name, "-c:v", "mpeg4", "-qscale:v", "3", *(["-movflags", "+faststart"] if name.endswith("mp4") else [])
    )
    cut_in_half(path)
    frames, complaints, _, missing = frames_and_complaints(path)
    assert 10 < len(frames) < 60
    assert len(frames) + missing == pytest.approx(75, abs=1)
    assert re.search(
        rf"{name} ends after 1\.[0-9] s of 3\.0 s: it is cut short: copy the video again\.", complaints[-1]
    )


@pytest.mark.parametrize(
    ("name", "content"), [("text.mp4", b"no video" * 100), ("empty.mp4", b""), ("data.bin", bytes(9999))]
)
def test_a_file_that_is_no_video_is_refused(name, content, tmp_path, capfd):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SourceError, match=f"{name} .*video"):
        open_source(str(tmp_path / name), live=False)
    assert capfd.readouterr().err == ""


def test_a_single_image_and_an_empty_folder_are_refused(folder, tmp_path):
    write_picture(tmp_path / "photo.jpg")
    with pytest.raises(SourceError, match=r"photo\.jpg"):
        open_source(str(tmp_path / "photo.jpg"), live=False)
    with pytest.raises(SourceError, match="no images"):
        open_source(str(folder), live=False)
