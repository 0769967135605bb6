"""Where the pictures of a recorded flight of ours were taken, by its log."""

import cv2
import pytest
from commands import run_json
from fakes import make_vehicle
from pictures import draw_texture

from edgevpr.core.errors import UsageError
from edgevpr.frames.positions import read_positions
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.recording import Recording
from edgevpr.tracks.record import read_record

FRAME_S = 100.0


def make_vehicles():
    """Reports at the time of each picture: one that counts, none, an old one, no GPS, our fix just now and long ago."""
    return (
        make_vehicle(50.1, 8.0, FRAME_S, roll_deg=3.0, height_m=80.0),
        None,
        make_vehicle(50.2, 8.0, FRAME_S - 1.5),
        make_vehicle(50.3, 8.0, FRAME_S, has_gps=False),
        make_vehicle(50.4, 8.0, FRAME_S, t_fix_s=FRAME_S - 9.0),
        make_vehicle(50.5, 8.0, FRAME_S, t_fix_s=FRAME_S - 11.0),
    )


def fly(tmp_path, is_live=True):
    """Write the log of a recorded flight, and return it and the folder of its pictures."""
    jpeg = cv2.imencode(".jpg", draw_texture(1, 48, 64))[1].tobytes()
    with Recording(tmp_path / "recorded", 1000) as recording, FlightLog(tmp_path / "flight.jsonl") as log:
        log.write("start", recording=str(recording.path))
        recording.note("is_live", is_live)
        for number, vehicle in enumerate(make_vehicles()):
            recording.note("frame", {"name": f"frame {number}", "number": recording.store_frame(jpeg)})
            log.write("query", query=f"frame {number}", t_frame_s=FRAME_S, vehicle=vehicle)
    return tmp_path / "flight.jsonl", recording.path / "frames"


def test_positions_places_the_pictures_of_a_flight_while_the_autopilot_had_gps(tmp_path, capsys):
    log, frames = fly(tmp_path)
    said = run_json(capsys, "positions", log, "--images", frames)
    assert (said["placed"], said["of"]) == (2, 6)
    tags = {name: tag for name, tag in read_positions(frames / "positions.csv").items() if tag.position}
    assert {name: tag.position.lat_deg for name, tag in tags.items()} == {"000001.jpg": 50.1, "000006.jpg": 50.5}
    assert (tags["000001.jpg"].roll_deg, tags["000001.jpg"].height_m) == (3.0, 80.0)


def test_read_record_refuses_a_flight_without_a_recording_in_one_sentence(tmp_path):
    with FlightLog(tmp_path / "flight.jsonl") as log:
        log.write("start", recording=None)
        log.write("query", query="frame 0", t_frame_s=FRAME_S, vehicle=make_vehicles()[0])
    with pytest.raises(UsageError, match="record: FOLDER"):
        read_record(tmp_path / "flight.jsonl")


def test_read_record_refuses_a_flight_over_a_folder_in_one_sentence(tmp_path):
    log, _ = fly(tmp_path, is_live=False)
    with pytest.raises(UsageError, match="camera"):
        read_record(log)
