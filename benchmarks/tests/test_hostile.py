"""A short form of `benchmarks/hostile_inputs.py`: real commands over generated hostile inputs."""

import random

import hostile_files
import hostile_inputs
import pytest

from edgevpr.frames.exif import read_exif
from edgevpr.frames.images import read_image


def test_no_hostile_input_ends_a_command_otherwise_than_with_a_sentence():
    for row in hostile_inputs.run(count=2, seed=7):
        assert row.tried == 2
        assert (row.tracebacks, row.hangs, row.wrong_exit_codes, row.leaks) == (0, 0, 0, 0), row


@pytest.mark.parametrize(
    ("program", "wrong"),
    [
        ("raise ValueError", "traceback"),
        ("import time; time.sleep(60)", "hang"),
        ("import sys; sys.exit('edgevpr: \\x1b[31m')", "leak"),
        ("import sys; sys.exit(2)", "exit code"),  # and no sentence
        ("import os; os.kill(os.getpid(), 9)", "exit code"),
    ],
)
def test_what_goes_wrong_is_counted(program, wrong, tmp_path, monkeypatch):
    (tmp_path / "edgevpr.py").write_text(program)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    if wrong == "hang":
        monkeypatch.setattr(hostile_inputs, "LIMIT_S", 1.0)
    attempt = hostile_inputs.Attempt(argv=["x"], codes=frozenset((0, 1, 2)))
    assert wrong in [each for each, _ in hostile_inputs._wrongs(attempt, tmp_path)]


def test_the_same_seed_makes_the_same_files(tmp_path):
    jpeg = hostile_files.picture(".jpg", 1)
    first, again = (hostile_files.with_exif(jpeg, random.Random(3)) for _ in range(2))
    assert first == again != hostile_files.with_exif(jpeg, random.Random(4))


def test_exif_data_of_every_kind_ends_and_leaves_the_picture(tmp_path):
    jpeg, positions = hostile_files.picture(".jpg", 1), 0
    for seed in range(150):
        (tmp_path / "a.jpg").write_bytes(hostile_files.with_exif(jpeg, random.Random(seed)))
        tag = read_exif(tmp_path / "a.jpg")
        positions += tag.position is not None
        if tag.position:
            assert abs(tag.position.lat_deg) <= 90
            assert abs(tag.position.lon_deg) <= 180
        assert tag.t_utc_s is None or -2.3e9 < tag.t_utc_s < 7.3e9
        assert tag.heading_deg is None or 0 <= tag.heading_deg < 360
        assert read_image(tmp_path / "a.jpg").shape[2] == 3
    assert positions  # else the generator makes nothing but rubbish
