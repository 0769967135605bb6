"""Which picture was taken where: by name, in order, by time and by how pictures move, and the command for people."""

from datetime import datetime, timedelta, timezone

import cv2
import numpy as np
import pytest
from commands import expect_refusal, run, run_json
from pictures import draw_texture
from PIL import Image
from recordings import START_S, write_dataflash, write_gpx

from edgevpr.core.geodesy import offset_position
from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, read_positions
from edgevpr.tracks.clock import estimate_clock_offset_s
from edgevpr.tracks.record import read_record
from edgevpr.tracks.triggers import match_triggers

SIDE_PX = 240
GROUND_PX = 2400
HOME = (50.0, 8.0)


def write_photograph(path, t_s, picture=None, clock_off_s=0.0):
    """Write a JPEG whose camera shows the time `t_s` of the flight, in seconds from its start."""
    exif = Image.Exif()
    shown = datetime.fromtimestamp(START_S + t_s - clock_off_s, timezone.utc)
    exif.get_ifd(0x8769)[0x9003] = shown.strftime("%Y:%m:%d %H:%M:%S")
    Image.fromarray(draw_texture(1, 48, 64) if picture is None else picture).save(path, "JPEG", exif=exif, quality=92)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "flight").mkdir()
    for number in range(6):
        write_photograph(tmp_path / "flight" / f"IMG_{number}.JPG", 2 * number + 1)
    return tmp_path / "flight"


def make_points(count=15, lat_step=1e-4):
    return [(t, HOME[0] + lat_step * t, HOME[1], 120.0, 30.0, 0.0, 0.0, 0.0) for t in range(count)]


def test_positions_assigns_images_by_name(capsys, folder, tmp_path):
    rows = "".join(f"D:\\pics\\img_{number}.tif;50.{number + 1};8\n" for number in range(5))
    (tmp_path / "table.csv").write_text(f"imagename;latitude;longitude\n{rows}")
    assert run("positions", tmp_path / "table.csv", "--images", folder) == 0
    assert [line.split() for line in capsys.readouterr().out.splitlines()][2:4] == [["placed", "5"], ["of", "6"]]
    tags = read_positions(folder / "positions.csv")
    assert tags["IMG_3.JPG"].position.lat_deg == pytest.approx(50.4)
    assert tags["IMG_3.JPG"].t_utc_s == START_S + 7, "what the table does not say is taken from the picture"
    assert "already exists" in expect_refusal(capsys, "positions", tmp_path / "table.csv", "--images", folder)


def make_shots(*times_s):
    """Triggers at these times, each at a latitude of its own."""
    return [(t_s, HOME[0] + 1e-3 * t_s, HOME[1], 120.0, 30.0, 0.0, 0.0, 0.0) for t_s in times_s]


def test_positions_places_triggered_pictures_in_order(capsys, folder, tmp_path):
    write_dataflash(tmp_path / "f.bin", make_points(), shots=make_shots(*range(1, 13, 2)))
    found = run_json(capsys, "positions", tmp_path / "f.bin", "--images", folder)
    assert (found["placed"], found["of"], found["offset_s"]) == (6, 6, None)
    tags = read_positions(folder / "positions.csv")
    assert [tag.position.lat_deg for tag in tags.values()] == pytest.approx([50 + 1e-3 * t for t in range(1, 13, 2)])


@pytest.mark.parametrize("clock_off_s", [0, -2.5e8], ids=["clock right", "clock never set"])
@pytest.mark.parametrize(
    ("taken_s", "names", "triggers_s", "placed_s"),
    [
        ((1, 4, 6, 11, 13, 16), (3, 4, 5, 0, 1, 2), (1, 4, 6, 11, 13, 16), (1, 4, 6, 11, 13, 16)),
        ((-60, 1, 4, 6, 13, 16), range(6), (1, 4, 6, 11, 13, 16), (1, 4, 6, 13, 16)),
        ((1, 4, 6, 11, 13), range(5), (1, 1, 4, 4, 6, 6, 11, 11, 13, 13), (1, 4, 6, 11, 13)),
        ((1.0, 1.8, 2.6, 3.4, 4.2), range(5), (1.0, 1.8, 2.6, 3.4, 4.2), (1.0, 1.8, 2.6, 3.4, 4.2)),
    ],
    ids=["counter rolls over", "test image, one missed", "each trigger twice", "more than one a second"],
)
def test_match_triggers_goes_by_the_intervals(taken_s, names, triggers_s, placed_s, clock_off_s):
    by_name = sorted(zip(names, taken_s, strict=True))
    images = {f"{name}": GeoTag(t_utc_s=START_S + int(t_s) + clock_off_s) for name, t_s in by_name}
    shots = [GeoTag(position=Position(t_s, 8.0), t_utc_s=START_S + t_s) for t_s in triggers_s]
    tags, how = match_triggers(shots, images)
    placed = {f"{name}": t_s for name, t_s in by_name if t_s in placed_s}
    assert {name: tag.position.lat_deg for name, tag in tags.items()} == placed
    assert ("by time" in how) == (list(names) != sorted(names))
    assert ("1 of 6 images without" in how) == (len(placed) < len(images))


@pytest.mark.parametrize(("clock_off_s", "is_placed"), [(0, True), (3600, True), (37, False)])
def test_match_triggers_does_not_shift_images_by_equal_intervals(clock_off_s, is_placed):
    triggers_s = 1.3 + 2.5 * np.arange(40)
    images = {f"{t_s:g}": GeoTag(t_utc_s=START_S + int(t_s) + clock_off_s) for t_s in triggers_s[5:]}
    matched = match_triggers([GeoTag(t_utc_s=START_S + t_s) for t_s in triggers_s], images)
    assert (matched is not None) == is_placed
    assert all(f"{tag.t_utc_s - START_S:g}" == name for name, tag in (matched[0] if matched else {}).items())


@pytest.mark.parametrize("taken_s", [(1, 2, 3, 9, 11), (0, 1, 2, 3, 4, 5, 6)], ids=["other intervals", "too coarse"])
def test_match_triggers_refuses_images_of_other_triggers(taken_s):
    images = {f"{t_s}": GeoTag(t_utc_s=START_S + t_s) for t_s in taken_s}
    assert match_triggers([GeoTag(t_utc_s=START_S + t_s) for t_s in np.linspace(1, 6, 5)], images) is None


def test_positions_assigns_images_by_time_if_their_number_differs(capsys, folder, tmp_path):
    write_dataflash(tmp_path / "f.bin", make_points(), shots=make_points(3))
    found = run_json(capsys, "positions", tmp_path / "f.bin", "--images", folder)
    assert (found["placed"], found["offset_s"]) == (6, 0)
    tag = read_positions(folder / "positions.csv")["IMG_3.JPG"]
    assert tag.position.lat_deg == pytest.approx(50 + 7e-4, abs=2e-6)
    assert (tag.height_m, tag.t_utc_s) == (pytest.approx(30, abs=0.1), START_S + 7)


@pytest.mark.parametrize(("hours", "track_s"), [(2, 2600), (-9.5, 700)])
def test_positions_finds_the_time_zone_of_the_camera(capsys, tmp_path, hours, track_s):
    folder = tmp_path / "flight"
    folder.mkdir()
    for number in range(12):  # the first one before the logger started
        write_photograph(folder / f"{number}.jpg", 60 * number - 20, clock_off_s=3600 * hours)
    write_gpx(tmp_path / "t.gpx", [(t, HOME[0] + 1e-5 * t, HOME[1]) for t in range(0, track_s, 2)])
    found = run_json(capsys, "positions", tmp_path / "t.gpx", "--images", folder)
    assert (found["placed"], found["offset_s"]) == (11, 3600 * hours)


def test_positions_refuses_an_ambiguous_time_zone(capsys, folder, tmp_path):
    write_gpx(tmp_path / "t.gpx", [(t, HOME[0], HOME[1] + 1e-6 * t) for t in range(4000, 20_000, 4)])
    assert "--offset-s" in expect_refusal(capsys, "positions", tmp_path / "t.gpx", "--images", folder)
    placed = run_json(capsys, "positions", tmp_path / "t.gpx", "--images", folder, "--offset-s", 7200)["placed"]
    assert placed == 6


def test_positions_refuses_pictures_of_another_day_with_both_times(capsys, folder, tmp_path):
    write_gpx(tmp_path / "t.gpx", [(t + 300_000, *HOME) for t in range(9)])
    day = (datetime.fromtimestamp(START_S, timezone.utc) + timedelta(seconds=300_000)).date().isoformat()
    assert day in expect_refusal(capsys, "positions", tmp_path / "t.gpx", "--images", folder)
    assert not (folder / "positions.csv").exists()


def fly_curves(count=40):
    """Return a track at 5 Hz, (seconds, lat, lon), of an aircraft that flies curves, and pictures of the ground that it
    takes every two seconds, its camera turned by 30 degrees against its nose."""
    ground = draw_texture(5, GROUND_PX, GROUND_PX)
    third = GROUND_PX // 3
    ground[:third, :third] = draw_texture(6, GROUND_PX, GROUND_PX)[-third:, -third:]
    noise = np.random.default_rng(2).normal(0, 25, (GROUND_PX // 6, GROUND_PX // 6))
    ground = np.clip(ground + cv2.resize(noise, ground.shape[::-1], interpolation=cv2.INTER_CUBIC), 0, 255)
    t_s = np.arange(0, 2 * count + 0.1, 0.2)
    course = 0.9 * np.sin(t_s / 5) + t_s / 14
    at = np.cumsum(2.4 * np.exp(1j * (np.pi / 2 - course)))  # right + i up, in pixels of the ground, that are metres
    at += GROUND_PX * 0.5 * (1 - 1j) - (at.real.max() + at.real.min()) / 2 - 1j * (at.imag.max() + at.imag.min()) / 2
    pictures = []
    for number in range(0, len(t_s), 10):
        turn = cv2.getRotationMatrix2D((at[number].real, -at[number].imag), np.degrees(course[number]) + 30, 1.0)
        turn[:, 2] += SIDE_PX / 2 - np.array([at[number].real, -at[number].imag])
        pictures.append(cv2.warpAffine(ground.astype(np.uint8), turn, (SIDE_PX, SIDE_PX), flags=cv2.INTER_LINEAR))
    rows = zip(t_s.tolist(), at.real, at.imag, strict=True)
    return [(t, *offset_position(*HOME, east, north)) for t, east, north in rows], pictures


@pytest.mark.slow
def test_estimate_clock_offset_s_sets_the_clock_by_the_motion_of_the_pictures(capsys, tmp_path):
    track, pictures = fly_curves()
    folder = tmp_path / "flight"
    folder.mkdir()
    for number, picture in enumerate(pictures):
        write_photograph(folder / f"{number}.jpg", 2 * number, picture, clock_off_s=3600 - 17)
    write_gpx(tmp_path / "t.gpx", track)
    found = run_json(capsys, "positions", tmp_path / "t.gpx", "--images", folder)
    assert found["offset_s"] == pytest.approx(3583, abs=0.8)
    straight = tmp_path / "straight.gpx"
    write_gpx(straight, [(t, HOME[0] + 1e-5 * t, HOME[1]) for t in range(90)])
    paths = [folder / f"{number}.jpg" for number in range(len(pictures))]
    times = [START_S + 2 * number for number in range(len(pictures))]
    assert estimate_clock_offset_s(read_record(straight).track, times, paths) is None, "another flight sets no clock"
