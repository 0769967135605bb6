"""The status socket with real readers: quick ones, slow ones, dead ones, and other flights."""

import json
import os
import socket
import stat
import subprocess
import sys
from contextlib import closing
from dataclasses import asdict, replace

import pytest
from statuses import STATUS

from edgevpr.core.errors import EdgevprError
from edgevpr.runtime.flight.statussocket import StatusSocket, usual_path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "status.sock"


def reader(path):
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(60)
    connection.connect(str(path))
    return closing(connection)


def read_to_end(connection):
    return b"".join(iter(lambda: connection.recv(65_536), b""))


def test_every_reader_is_told_every_status_as_a_line(path):
    with StatusSocket(path) as told, reader(path) as first:
        told.tell(STATUS)
        with reader(path) as second:
            told.tell(replace(STATUS, queries=2))
            told.close()
            lines = read_to_end(first).splitlines()
            assert json.loads(lines[0]) == asdict(STATUS)
            assert [json.loads(line)["queries"] for line in lines] == [1204, 2]
            assert json.loads(read_to_end(second))["queries"] == 2


@pytest.mark.parametrize("umask", [0, 0o022, 0o077])
def test_the_socket_is_for_its_user_and_group_whatever_the_umask(umask, path):
    before = os.umask(umask)
    try:
        with StatusSocket(path):
            mode = path.lstat().st_mode
    finally:
        os.umask(before)
    assert stat.S_ISSOCK(mode)
    assert mode & 0o777 == 0o660


def test_the_file_is_removed_at_the_end_and_only_if_it_is_ours(path):
    with StatusSocket(path):
        assert path.exists()
    assert not path.exists()
    with StatusSocket(path) as one:
        path.unlink()
        with StatusSocket(path):
            one.close()
            with reader(path):
                pass


def test_a_socket_that_a_killed_flight_has_left_is_replaced(path):
    script = "import os, sys; from edgevpr.runtime.flight.statussocket import StatusSocket\n"
    script += "StatusSocket(sys.argv[1]); os.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", script, path]).returncode == -9
    assert path.exists()
    with StatusSocket(path), reader(path):
        pass


def test_one_that_another_flight_has_is_refused_and_stays(path):
    with StatusSocket(path) as one:
        with pytest.raises(EdgevprError, match=r"^Another flight tells its status at .*: end it, or give this one"):
            StatusSocket(path)
        with reader(path) as listening:
            one.tell(STATUS)
            assert listening.recv(65_536)


def test_one_that_hangs_and_has_many_waiting_is_in_use_too(path):
    with StatusSocket(path):
        waiting = []
        try:
            while True:
                waiting.append(connection := socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
                connection.setblocking(False)
                connection.connect(str(path))
        except BlockingIOError:  # the queue is full
            pass
        with pytest.raises(EdgevprError, match=r"^Another flight"):
            StatusSocket(path)
        for each in waiting:
            each.close()


def test_what_is_no_socket_is_never_removed(path):
    path.write_text("precious")
    with pytest.raises(EdgevprError, match="is there and is no socket"):
        StatusSocket(path)
    assert path.read_text() == "precious"


@pytest.mark.parametrize("name", ["absent/s", "x" * 200, "file/s"])
def test_a_path_that_cannot_be_made_is_one_sentence(name, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(EdgevprError, match=r"^The status socket .* cannot be made \(.*\): give a short name"):
        StatusSocket(tmp_path / name)


def test_a_reader_that_does_not_read_is_let_go_and_had_whole_lines_only(path):
    with StatusSocket(path) as told, reader(path) as slow, reader(path) as quick:
        for number in range(1000):
            told.tell(replace(STATUS, queries=number))
            assert json.loads(quick.recv(65_536))["queries"] == number
        lines = read_to_end(slow)
        assert lines.endswith(b"}\n")
        seen = [json.loads(line)["queries"] for line in lines.splitlines()]
        assert seen == list(range(len(seen)))
        assert 5 < len(seen) < 1000


def test_a_reader_that_has_gone_is_forgotten(path):
    with StatusSocket(path) as told:
        for _ in range(100):  # more than are heard at once
            with reader(path):
                told.tell(STATUS)
            told.tell(STATUS)
        with reader(path) as last:
            told.tell(STATUS)
            assert last.recv(65_536)


def test_no_more_readers_than_there_are_descriptors_for(path):
    with StatusSocket(path) as told:
        descriptors = len(os.listdir("/proc/self/fd"))
        readers = [reader(path) for _ in range(50)]
        told.tell(STATUS)
        assert len(os.listdir("/proc/self/fd")) < descriptors + 50 + 50
        for each in readers[:40]:
            each.thing.close()
        told.tell(STATUS)
        told.tell(STATUS)  # those who waited have their turn
        assert all(each.thing.recv(65_536) for each in readers[40:])
        for each in readers[40:]:
            each.thing.close()


def test_a_child_does_not_inherit_it(path):
    script = "import os; print([os.readlink(f'/proc/self/fd/{n}') for n in os.listdir('/proc/self/fd') if int(n) > 2])"
    with StatusSocket(path) as told, reader(path):
        told.tell(STATUS)
        seen = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, close_fds=False)
    assert "socket:" not in seen.stdout


def test_no_password_is_told(path):
    with StatusSocket(path) as told, reader(path) as listening:
        told.tell(replace(STATUS, source="rtsp://pilot:secret@cam lost", remarks=["http://cam?pwd=secret"]))
        line = json.loads(listening.recv(65_536))
    assert line["source"] == "rtsp://pilot:***@cam lost"
    assert line["remarks"] == ["http://cam?pwd=***"]


@pytest.mark.parametrize(
    ("folder", "usual"), [("/run/edgevpr", "/run/edgevpr/status.sock"), ("/run/a:/run/b", "/run/a/status.sock")]
)
def test_a_service_has_its_socket_in_the_folder_that_systemd_made(folder, usual, monkeypatch):
    monkeypatch.setenv("RUNTIME_DIRECTORY", folder)
    assert usual_path() == usual
    monkeypatch.delenv("RUNTIME_DIRECTORY")
    assert usual_path() is None
