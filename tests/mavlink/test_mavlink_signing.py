"""Signing, against pymavlink's own: true, forged, replayed, future and unsigned messages, and the keys of users."""

import os
import re
import socket
import time
from contextlib import ExitStack, closing, suppress

import pytest
from loopback import free_port, wait_until
from mavlink_peers import make_link
from scripted_autopilot import Autopilot

from edgevpr.core.config import MavlinkConfig
from edgevpr.core.errors import ConfigError
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.signing import (
    AUTOPILOT_LINK_ID,
    FUTURE,
    NOT_SIGNING,
    OLD,
    TICKS_S,
    UNSIGNED,
    WRONG,
    Signing,
    TimeStamps,
    open_signing,
    read_key,
)
from edgevpr.mavlink.wire import PacketReader, mavlink

KEY = bytes(range(32))
OTHER_KEY = bytes(32)
NOW = 1_000_000 * TICKS_S  # the time stamp that the clocks of these tests begin with
UTC_S = 1_420_070_400 + NOW / TICKS_S
HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4, 3)


@pytest.fixture
def signing(tmp_path, clock):
    start_s = clock.now_s
    return Signing(KEY, TimeStamps(tmp_path / "time", clock, lambda: UTC_S + clock.now_s - start_s))


class Signer:
    """One stream of signed heartbeats, made by pymavlink."""

    def __init__(self, key: bytes = KEY, stamp: int = NOW, link_id: int = 0, system_id: int = 7) -> None:
        self.packer = mavlink.MAVLink(None, system_id, 1)
        self.packer.signing.sign_outgoing = True
        self.packer.signing.secret_key, self.packer.signing.link_id = key, link_id
        self.packer.signing.timestamp = stamp

    def packet(self, stamp: int | None = None, message=HEARTBEAT) -> bytes:
        if stamp is not None:
            self.packer.signing.timestamp = stamp
        return message.pack(self.packer)


def admit(signing: Signing, *packets: bytes) -> list[bool]:
    receiver = PacketReader(signing.admits)
    return [bool(list(receiver.feed(packet))) for packet in packets]


def make_unsigned(message=HEARTBEAT) -> bytes:
    return message.pack(mavlink.MAVLink(None, 7, 1))


def test_signing_admits_signed_messages_in_order_and_once(signing):
    signer = Signer()
    first, second, third = (signer.packet() for _ in range(3))
    assert admit(signing, first, third, second, third, first) == [True, True, False, False, False]
    assert signing.refused == {OLD: 3}


def test_signing_forged_future_timestamp_does_not_block_valid_messages(signing, clock):
    signer = Signer()
    forged = Signer(OTHER_KEY).packet(2**48 - 1)
    assert admit(signing, signer.packet(), forged, signer.packet()) == [True, False, True]
    assert signing.refused == {WRONG: 1}
    packer = mavlink.MAVLink(None, 1, 197)
    signing.stamp(packer)
    assert packer.signing.timestamp < NOW + 200 * TICKS_S, "our own time has moved with a forged one"


@pytest.mark.parametrize("place", range(len(Signer().packet())))
def test_signing_refuses_a_modified_message(signing, place):
    packet = bytearray(Signer().packet())
    packet[place] ^= 0x10
    assert admit(signing, packet) == [False]


def test_signing_refuses_counts_and_reports_unsigned_messages_once(signing, caplog):
    old_protocol = HEARTBEAT.pack(mavlink.MAVLink(None, 7, 1), force_mavlink1=True)
    assert not any(admit(signing, make_unsigned(), make_unsigned(), old_protocol))
    assert signing.refused == {UNSIGNED: 3}
    assert [record.args[0] for record in caplog.records] == [UNSIGNED]


def test_signing_accepts_unsigned_radio_status_but_not_as_the_autopilot(signing):
    message = mavlink.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)
    assert admit(signing, message.pack(mavlink.MAVLink(None, 51, 68))) == [True]
    assert signing.refused == {}
    assert admit(signing, make_unsigned(message)) == [False]
    assert signing.refused == {UNSIGNED: 1}
    assert admit(signing, Signer().packet(message=message)) == [True]


@pytest.mark.parametrize(
    ("ahead_s", "refused"),
    [(-3600, {OLD: 1}), (-61, {OLD: 1}), (-59, {}), (59, {}), (61, {FUTURE: 1}), (3600, {FUTURE: 1})],
)
def test_signing_requires_a_new_stream_within_a_minute(signing, ahead_s, refused):
    admit(signing, Signer().packet(), Signer(stamp=NOW + ahead_s * TICKS_S, link_id=1).packet())
    assert signing.refused == refused


def test_signing_first_stream_may_be_ahead_and_sets_the_time(signing, clock):
    """A board without a clock chip that was off for a week learns the time from the autopilot."""
    week = 7 * 86_400 * TICKS_S
    assert admit(signing, Signer(stamp=NOW + week).packet()) == [True]
    packer = mavlink.MAVLink(None, 1, 197)
    clock.now_s += 5
    signing.stamp(packer)
    assert packer.signing.timestamp == NOW + week + 5 * TICKS_S
    assert admit(signing, Signer(stamp=NOW, link_id=1).packet()) == [False]


@pytest.fixture
def key_file(tmp_path):
    path = tmp_path / "signing.key"
    path.write_bytes(KEY)
    path.chmod(0o600)
    return path


@pytest.mark.network
def test_signing_is_compatible_with_pymavlink(key_file, monkeypatch):
    monkeypatch.setenv("MAVLINK20", "1")
    from pymavlink import mavutil

    number = free_port()
    signing = open_signing(MavlinkConfig(signing_key=str(key_file)))
    with make_link(f"udpin:127.0.0.1:{number}", signing=signing) as link:
        url = f"udpout:127.0.0.1:{number}"
        other = mavutil.mavlink_connection(url, dialect="all", source_system=7, source_component=1)
        other.setup_signing(KEY, sign_outgoing=True)
        with closing(other):

            def beat() -> bool:
                other.mav.heartbeat_send(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4)
                request = other.recv_match(type="TIMESYNC", blocking=True, timeout=0.1)
                return request and other.mav.timesync_send(1, request.ts1) is None

            wait_until(beat, "believing the autopilot that signs")
            link.send_fix(Fix(50.0, 14.0, 25.0, time.monotonic()))
            fix = wait_until(lambda: other.recv_match(type="COMMAND_INT", blocking=True, timeout=1), "the fix")
            assert fix.get_signed()
            assert fix.get_link_id() == AUTOPILOT_LINK_ID
            assert other.mav.signing.badsig_count == 0
    assert (key_file.parent / "signing.key.time").exists()


@pytest.mark.network
def test_signing_autopilot_with_an_old_clock_learns_the_time_despite_an_earlier_sender(key_file):
    """As after a flat battery of its clock: it takes ours from the first message that it gets, so it must get one."""
    number, day = free_port(), 86_400 * TICKS_S
    signing = open_signing(MavlinkConfig(signing_key=str(key_file)))
    with make_link(f"udpin:127.0.0.1:{number}", signing=signing) as link, ExitStack() as stack:
        stray, own, replaying = (stack.enter_context(closing(make_socket(number))) for _ in range(3))
        stray.send(make_unsigned())
        wait_until(lambda: link.stats().refused_signatures, "the stray packet")
        signer = Signer(stamp=int((time.time() - 1_420_070_400) * TICKS_S) - day)
        old = signer.packet()

        def beat() -> bool:
            own.send(signer.packet())
            for message in PacketReader().feed(receive(own)):
                signer.packer.signing.timestamp = int.from_bytes(message.get_msgbuf()[-12:-6], "little") + 1
            return link.stats().autopilot_heard

        wait_until(beat, "believing it")
        replaying.send(old)
        wait_until(lambda: link.stats().refused_signatures.get(OLD, 0) > 1, "refusing what is sent again")
        link.send_fix(Fix(50.0, 14.0, 25.0, time.monotonic()))
        wait_until(lambda: receive(own), "the fix, not sent elsewhere")
        assert receive(replaying) == b""


def make_socket(number: int) -> socket.socket:
    """A socket of its own address that sends to a port of this machine."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.connect(("127.0.0.1", number))
    sock.setblocking(False)
    return sock


def receive(sock: socket.socket) -> bytes:
    with suppress(BlockingIOError):
        return sock.recv(4096)
    return b""


def test_signing_sends_no_fix_to_an_autopilot_without_the_key(signing):
    autopilot = Autopilot(signing=signing)
    assert autopilot.put_fix().sent is None
    assert signing.refused[UNSIGNED] > 1
    assert autopilot.conversation.reader.received == {}


def test_signing_without_a_key_admits_everything_and_signs_nothing():
    assert open_signing(MavlinkConfig()) is NOT_SIGNING
    packer = mavlink.MAVLink(None)
    NOT_SIGNING.stamp(packer)
    assert not packer.signing.sign_outgoing
    assert admit(NOT_SIGNING, make_unsigned(), Signer(OTHER_KEY).packet()) == [True, True]


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o610, 0o602, 0o440])
def test_read_key_refuses_a_key_that_others_can_read_even_through_a_symlink(key_file, mode):
    link = key_file.with_name("link.key")
    link.symlink_to(key_file)
    for path in (key_file, link):
        key_file.chmod(0o400)
        assert read_key(str(path)) == KEY
        key_file.chmod(mode)
        with pytest.raises(ConfigError, match=re.escape(f"`chmod 600 {path}`")):
            read_key(str(path))


def test_read_key_refuses_a_key_of_another_length_or_type(key_file, tmp_path):
    for content in (b"", KEY[:31], KEY + b"\n"):
        key_file.write_bytes(content)
        with pytest.raises(ConfigError, match="32 bytes"):
            read_key(str(key_file))
    os.mkfifo(tmp_path / "pipe", 0o600)
    for name in ("missing", "pipe", "."):
        with pytest.raises(ConfigError, match="urandom"):
            read_key(str(tmp_path / name))


def test_read_key_accepts_a_systemd_credential(key_file, monkeypatch):
    """With `User=`, the service reads it by an access list, which shows as the right of its group."""
    key_file.chmod(0o440)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(key_file.parent))
    assert read_key(str(key_file)) == KEY
    key_file.chmod(0o444)
    with pytest.raises(ConfigError, match="chmod"):
        read_key(str(key_file))
