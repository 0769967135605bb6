"""Reading a status: before there is a flight, in flight, and over to the next one."""

import json
import os
import socket
from contextlib import contextmanager
from dataclasses import asdict, replace

import pytest
from statuses import STATUS

from edgevpr.core.errors import EdgevprError
from edgevpr.runtime.flight.statusreader import StatusReader
from edgevpr.runtime.flight.statussocket import StatusSocket


@pytest.fixture
def path(tmp_path):
    return tmp_path / "status.sock"


@contextmanager
def speaker(path):
    """Somebody who says other things than a flight: gives the call that does so to the reader that has connected."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen()

        def say(*pieces):
            with listener.accept()[0] as connection:
                for each in pieces:
                    connection.sendall(each)

        yield say
    os.unlink(path)


def connected(reader):
    while reader.trouble:
        assert reader.read(0.01) is None


def test_the_reader_waits_for_a_flight_and_goes_on_with_the_next(path):
    with StatusReader(path) as reader:
        assert reader.read(0.01) is None
        assert reader.trouble == f"no flight tells its status at {path}"
        for queries in (1, 2):
            with StatusSocket(path) as told:
                connected(reader)
                told.tell(replace(STATUS, queries=queries))
                assert reader.read(60) == replace(STATUS, queries=queries)
            assert reader.read(0.01) is None
            assert reader.trouble


def test_a_reader_that_was_held_up_gets_the_newest(path):
    with StatusReader(path) as reader, StatusSocket(path) as told:
        connected(reader)
        for queries in range(5):
            told.tell(replace(STATUS, queries=queries))
        assert reader.read(60).queries == 4


def test_a_socket_that_a_killed_flight_has_left_is_no_flight(path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
    with StatusReader(path) as reader:
        assert reader.read(0.01) is None
        assert reader.trouble == f"no flight tells its status at {path}"


def test_a_line_in_pieces_is_read_and_a_cut_one_is_left_out(path):
    line = json.dumps(asdict(STATUS)).encode()
    with speaker(path) as say, StatusReader(path) as reader:
        connected(reader)
        say(line[:50], line[50:] + b"\n" + line[:70])
        assert reader.read(60) == STATUS
        assert reader.read(0.01) is None


NEWER = json.dumps({**asdict(STATUS), "moon": "full"}).encode()
OTHER = json.dumps({**asdict(STATUS), "queries": "many"}).encode()


@pytest.mark.parametrize("line", [b"HTTP/1.1 200 OK", b"[1]", b"{}", b"\xff\xfe", b"[" * 100_000, NEWER, OTHER])
def test_what_is_no_status_is_one_sentence(line, path):
    with speaker(path) as say, StatusReader(path) as reader:
        connected(reader)
        say(line[:60_000] + b"\n")
        with pytest.raises(EdgevprError, match="tells no status that this edgevpr understands: use the edgevpr of the"):
            reader.read(60)


def test_a_path_that_no_socket_can_have_is_one_sentence(tmp_path):
    for name in ("x" * 200, "file/s"):
        (tmp_path / "file").touch()
        with StatusReader(tmp_path / name) as reader, pytest.raises(EdgevprError, match=r"cannot be read .*--socket"):
            reader.read(0.01)
