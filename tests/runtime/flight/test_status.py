"""The status file: whole at every moment, for its user and group, and nobody else."""

import os

import pytest
from commands import expect_refusal, run_json
from fakes import FakeSource
from flights import draw_pictures

from edgevpr import __version__
from edgevpr.cli.main import main
from edgevpr.core.errors import EdgevprError
from edgevpr.runtime.flight.status import StatusFile, find_default_path, read_status

STATUS = {"version": __version__, "queries": 7}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "status.json"


def test_read_status_reads_what_was_written_until_the_flight_ends(path):
    with StatusFile(path) as told:
        assert read_status(path) is None
        for queries in (7, 8):
            told.write({**STATUS, "queries": queries})
            status, age_s = read_status(path)
            assert status == {**STATUS, "queries": queries}
            assert age_s < 60
        assert path.stat().st_mode & 0o777 == 0o660
        assert os.listdir(path.parent) == [path.name]
    assert read_status(path) is None


def test_status_file_has_the_same_mode_under_any_umask_and_replaces_leftovers(path):
    path.write_text("left by a flight that was killed")
    before = os.umask(0o077)
    try:
        with StatusFile(path) as told:
            told.write(STATUS)
            assert path.stat().st_mode & 0o777 == 0o660
            assert read_status(path)[0] == STATUS
    finally:
        os.umask(before)


@pytest.mark.parametrize("name", ["nowhere/status", ".", "x" * 300])
def test_status_file_refuses_an_unwritable_path_by_name(tmp_path, name):
    with pytest.raises(EdgevprError, match=r"status\.file"):
        StatusFile(tmp_path / name)


@pytest.mark.parametrize("text", ["", "no JSON", "[]", '{"version": 1}', "[" * 100_000])
def test_read_status_refuses_other_files_by_name(path, text):
    path.write_text(text)
    with pytest.raises(EdgevprError, match=path.name):
        read_status(path)


def test_top_shows_the_status_of_a_running_flight_only(make_flight, clock, path, capsys):
    assert "--file" in expect_refusal(capsys, "top", "--file", path, "--once", code=1)
    with StatusFile(path) as told:
        make_flight().fly(FakeSource([*draw_pictures(2), *draw_pictures(1, first=100)], clock), status=told)
        assert run_json(capsys, "top", "--file", path) == read_status(path)[0]
        assert main(["top", "--file", str(path), "--once"]) == 0
        os.utime(path, (0, 0))
        assert main(["top", "--file", str(path), "--once"]) == 1


@pytest.mark.parametrize(
    ("folder", "usual"),
    [("/run/edgevpr", "/run/edgevpr/status.json"), ("/run/a:/run/b", "/run/a/status.json"), ("", None)],
)
def test_find_default_path_uses_the_folder_of_the_service(monkeypatch, folder, usual):
    monkeypatch.setenv("RUNTIME_DIRECTORY", folder)
    assert find_default_path() == usual


def test_status_file_tolerates_a_full_disk(path):
    with StatusFile(path) as told:
        path.with_name(f"{path.name}.new").mkdir()
        told.write(STATUS)
    assert read_status(path) is None
