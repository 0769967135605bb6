"""The tlog on real links and files, read back by pymavlink's own reader and by its mavlogdump."""

import os
import struct
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest
from full_disk import no_file_larger_than
from loopback import wait_until
from mavlink_peers import Peer, UdpPort, link_to

from edgevpr.core.appending import numbered
from edgevpr.core.errors import EdgevprError
from edgevpr.mavlink import messages, tlog
from edgevpr.mavlink.messages import Fix, Health
from edgevpr.mavlink.tlog import Tlog
from edgevpr.mavlink.wire import PacketReader, mavlink

MAVLOGDUMP = Path(sys.prefix) / "bin" / "mavlogdump.py"


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "flight.tlog"


def packet(number: int) -> bytes:
    message = mavlink.MAVLink_named_value_int_message(number, b"n", number)
    return bytes(message.pack(mavlink.MAVLink(None, 1, 197)))


def record(path: Path, numbers: range) -> None:
    with Tlog(path) as log:
        for number in numbers:
            log.record(packet(number))


def read(path: Path) -> list:
    """The messages in a tlog as pymavlink's reader has them, what is damaged among them."""
    from pymavlink import mavutil

    with closing(mavutil.mavlink_connection(str(path))) as handle:
        return list(iter(handle.recv_msg, None))


def numbers(path: Path) -> list[int]:
    return [message.value for message in read(path) if message.get_type() == "NAMED_VALUE_INT"]


def records(path: Path) -> list[tuple[int, bytes]]:
    """Time stamps, microseconds since 1970, and packets, MAVLink 2. Every byte must belong to one."""
    data, found = path.read_bytes(), []
    while data:
        (t_us,) = struct.unpack_from(">Q", data)
        assert data[8] == 0xFD
        end = 8 + 10 + data[9] + 2
        assert len(data) >= end, "cut"
        found.append((t_us, data[8:end]))
        data = data[end:]
    return found


def dumped(path: Path, *flags: str) -> str:
    return subprocess.run(
        [sys.executable, MAVLOGDUMP, *flags, path], check=True, capture_output=True, text=True, timeout=60
    ).stdout


@pytest.mark.network
@pytest.mark.process
def test_both_directions_of_a_link_are_read_by_mavlogdump(path):
    began_us = time.time_ns() // 1000
    with closing(UdpPort()) as port, Tlog(path) as log:
        peer = Peer(port)
        with link_to(f"udpout:127.0.0.1:{port.number}", tap=log.record) as link:
            link.set_health(Health.ACTIVE)
            peer.expect("HEARTBEAT")
            port.send(b"no packet\xfd\x05" + bytes(300))
            peer.heartbeat()
            peer.synchronise(link)
            sending = link.send_fix(Fix(50.0, 8.0, 20.0, link.turns.now_s()))
            assert peer.expect("COMMAND_INT").x == 500_000_000
            wait_until(lambda: sending.sent)
            peer.answer_fix(mavlink.MAV_RESULT_ACCEPTED)
            port.send(unknown := b"\xfd\x01\x00\x00\x00\x01\x01\xff\xff\x7f\x00\x00\x00")
            wait_until(lambda: link.stats().received.get("UNKNOWN"))
        stats = link.stats()
    assert stats.bad_bytes > 0
    written = records(path)
    assert all(began_us - 4 <= t_us <= time.time_ns() // 1000 for t_us, _ in written)
    assert [t_us for t_us, _ in written] == sorted(t_us for t_us, _ in written)
    assert unknown in [each for _, each in written]
    names = [message.get_type() for message in PacketReader().feed(b"".join(each for _, each in written))]
    counted = {name: names.count(name) for name in names}
    assert counted == {**stats.sent, "HEARTBEAT": stats.sent["HEARTBEAT"] + 1, "TIMESYNC": 2, "COMMAND_ACK": 1}
    said = dumped(path, "--show-source")
    for words in ("COMMAND_INT {target_system : 1", "srcComponent=197", "COMMAND_ACK {command : 43003"):
        assert words in said
    assert "BAD_DATA" not in said
    fix = next(message for message in read(path) if message.get_type() == "COMMAND_INT")
    assert (fix.get_srcSystem(), fix.get_srcComponent(), fix.command) == (1, 197, messages.POSITION_FIX)
    assert began_us / 1e6 - 1 < fix._timestamp < time.time() + 1


@pytest.mark.slow
def test_what_comes_after_a_cut_packet_is_read(path):
    record(path, range(20))
    os.truncate(path, os.path.getsize(path) - 7)  # a pulled battery
    record(path, range(20, 40))
    found = numbers(path)
    assert found[:19] == list(range(19))
    assert found[-15:] == list(range(25, 40)), "no more than a few after the cut are lost"
    assert "value : 39}" in dumped(path, "--robust")


def test_a_full_disk_ends_the_log_is_said_once_and_leaves_whole_packets(path, caplog, monkeypatch):
    monkeypatch.setattr(tlog, "WRITE_S", 0.01)
    with Tlog(path) as log, no_file_larger_than(1000):
        for number in range(1000):
            log.record(packet(number))
            time.sleep(0.0002)
        wait_until(lambda: log._ended)
        log.record(packet(0))
        assert not log._waiting
    kept = [message for _, message in records(path)]
    assert kept == [packet(number) for number in range(len(kept))]
    assert len(caplog.records) == 1
    assert "(File too" in caplog.text


def test_the_last_of_a_disk_is_left_to_the_flight_log(path, caplog, monkeypatch):
    monkeypatch.setattr(tlog, "SPARED_BYTES", 10**18)
    record(path, range(3))
    assert path.read_bytes() == b""
    assert "MB are" in caplog.text


@pytest.mark.slow
def test_a_slow_disk_keeps_nobody_waiting_and_fills_no_memory(path, caplog, monkeypatch):
    is_slow, go_on = threading.Event(), threading.Event()

    def slow(file, data):
        is_slow.set()
        assert go_on.wait(60)
        append(file, data)

    append = tlog.append
    monkeypatch.setattr(tlog, "append", slow)
    monkeypatch.setattr(tlog, "WRITE_S", 0.001)
    monkeypatch.setattr(tlog, "CLOSE_S", 60.0)
    with Tlog(path) as log:
        log.record(packet(0))
        assert is_slow.wait(60)
        for number in range(1, 20_000):
            log.record(packet(number))
        assert len(log._waiting) <= tlog.WAITING_MAX
        go_on.set()
    assert numbers(path) == [0], "what came before the gap"
    assert "has ended (the disk is too slow for it)" in caplog.text


def test_there_are_never_more_than_two_files_of_the_largest_size(path, monkeypatch):
    monkeypatch.setattr(tlog, "MOST_BYTES", 1000)
    for first in range(0, 200, 10):
        record(path, range(first, first + 10))
    assert os.stat(path).st_mode & 0o777 == 0o640
    (older,) = numbered(path)
    assert sorted(path.parent.iterdir()) == [older, path]
    assert max(path.stat().st_size, older.stat().st_size) <= 1000
    found = numbers(older) + numbers(path)
    assert found == list(range(200 - len(found), 200)), "the newest"


def test_a_file_that_cannot_be_opened_is_one_sentence(tmp_path):
    with pytest.raises(EdgevprError, match="No such"):
        Tlog(tmp_path / "no" / "x.tlog")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(EdgevprError, match="symbolic"):
        Tlog(tmp_path / "loop")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(EdgevprError, match="not a file"):
        Tlog(tmp_path / "pipe")
