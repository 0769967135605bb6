"""The recording of a flight: what is kept, and how it ends before it harms."""

import logging
import os

import numpy as np
import pytest
from fakes import FakeClock, FakeSource
from full_disk import limit_file_size
from loopback import wait_until
from pictures import draw_texture

from edgevpr.core.errors import ImageError
from edgevpr.frames.images import read_image
from edgevpr.review.tape import Playback, ReplayedSource, read_tape
from edgevpr.runtime.flight import recording as module
from edgevpr.runtime.flight.boundary import RecordedSource
from edgevpr.runtime.flight.recording import FRAMES, TAPE, Recording, frame_path, list_recordings


def read_notes(folder):
    return list(read_tape(folder / TAPE))


def test_recording_writes_reads_and_notes_in_order(tmp_path):
    with Recording(tmp_path / "r", 100) as tape:
        assert tape.read("one", lambda: 0.1 + 0.2) == 0.1 + 0.2
        tape.note("two", [1, "a"], None)
        tape.note("three")
    assert tape.path == tmp_path / "r" / "flight-0001"
    assert read_notes(tape.path) == [["one", 0.1 + 0.2], ["two", [1, "a"], None], ["three"]]


@pytest.mark.parametrize("is_grey", [False, True])
def test_recording_gives_the_flight_the_stored_image(tmp_path, is_grey):
    pictures = [draw_texture(number, 240, 320) for number in range(3)]
    pictures = pictures if is_grey else [np.dstack((each, 255 - each, each // 2)) for each in pictures]
    clock = FakeClock()
    with Recording(tmp_path, 100) as tape:
        source = RecordedSource(FakeSource([*pictures, ImageError("it is torn")], clock), tape, tape.store_frame)
        seen = [source.read(0.2) for _ in pictures]
        with pytest.raises(ImageError):
            source.read(0.2)
        assert source.ended
        state = source.state
    playback = Playback(iter(read_notes(tape.path)))
    again = ReplayedSource(playback, lambda number: read_image(frame_path(tape.path, number)))
    for frame in seen:
        replayed = again.read(0.2)
        assert np.array_equal(replayed.image, frame.image)
        assert (replayed.name, replayed.t_mono_s) == (frame.name, frame.t_mono_s)
    with pytest.raises(ImageError, match="torn"):
        again.read(0.2)
    assert again.ended
    assert again.state == state


def test_recording_hides_passwords_in_addresses(tmp_path):
    with Recording(tmp_path, 100) as tape:
        tape.note("flight", {"uri": "rtsp://pilot:secret@camera/1"})
    assert "secret" not in (tape.path / TAPE).read_text()


def test_recording_uses_one_folder_per_flight_and_deletes_the_oldest(tmp_path):
    for number in range(4):
        with Recording(tmp_path, 10) as tape:
            tape.store_frame(bytes(2_000_000))
            tape.note("x")
        assert tape.path.name == f"flight-{number + 1:04d}"
    with Recording(tmp_path, 10):  # the half of 10 MB is to be free
        wait_until(lambda: len(list_recordings(tmp_path)) < 5)
    assert [each.name for each in list_recordings(tmp_path)] == ["flight-0003", "flight-0004", "flight-0005"]


@pytest.mark.slow
def test_recording_ends_at_its_size_limit_and_reports_it(tmp_path, caplog):
    with caplog.at_level(logging.WARNING), Recording(tmp_path, 10) as tape:
        for _ in range(4):
            tape.store_frame(bytes(1_500_000))
            tape.note("frame")
            wait_until(lambda: not tape._queue)
        wait_until(lambda: tape.state)
        tape.store_frame(b"no more")
        tape.note("no more")
    assert "log.record_mb" in tape.state
    assert sum("has ended" in each.message for each in caplog.records) == 1
    assert ["no more"] not in read_notes(tape.path)
    assert len(list((tape.path / FRAMES).iterdir())) <= 4


@pytest.mark.slow
def test_recording_ends_on_a_full_disk_without_ending_the_flight(tmp_path):
    with Recording(tmp_path, 100) as tape:
        tape.note("x")
        wait_until(lambda: not tape._queue)
        with limit_file_size(5000):
            tape.store_frame(bytes(9000))
            tape.note("frame")
            wait_until(lambda: tape.state)
        tape.note("later")
    assert "too large" in tape.state
    assert read_notes(tape.path) == [["x"]]


@pytest.mark.slow
def test_recording_leaves_reserved_disk_space_for_logs_and_map(tmp_path, monkeypatch):
    disk = os.statvfs(tmp_path)
    monkeypatch.setattr(module, "MIN_FREE_BYTES", disk.f_bavail * disk.f_frsize + 10**12)
    with Recording(tmp_path, 100) as tape:
        tape.note("x")
        wait_until(lambda: tape.state)
    assert "MB free" in tape.state
