"""Which autopilot is ours: the one kept, others refused, and the rule by which one takes the place of another."""

import pytest

from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.peer import Endpoint, Identity
from edgevpr.mavlink.wire import mavlink

OURS = Endpoint(1, None)
FOREIGN = Endpoint(2, None)
HERE = ("127.0.0.1", 1000)
THERE = ("127.0.0.1", 2000)


def beat(identity: Identity, speaker: Endpoint, *times_s: float) -> list[bool]:
    return [identity.admits(speaker, True, t_s) for t_s in times_s]


def list_seconds(first: float, last: float) -> list[float]:
    """Every second from `first` to `last`."""
    return [first + count for count in range(round(last - first) + 1)]


def test_identity_keeps_the_first_autopilot_while_it_sends(caplog):
    identity = Identity()
    assert not identity.admits(OURS, False, 0.0), "what is no heartbeat makes nobody ours"
    for t_s in list_seconds(0, 100):
        assert identity.admits(OURS, True, t_s)
        assert not identity.admits(FOREIGN, True, t_s + 0.5)
        assert not identity.admits(FOREIGN, False, t_s + 0.6)
    assert identity.foreign_messages == 202
    for t_s in list_seconds(101, 400):
        assert not identity.admits(FOREIGN, True, t_s), "another system is never taken"
    assert identity.current == OURS
    assert caplog.text.count("system 2") == 1


def test_identity_accepts_the_same_system_elsewhere_after_thirty_seconds(caplog):
    identity = Identity()
    beat(identity, Endpoint(1, HERE), 0.0)
    for t_s in list_seconds(20, 40):
        assert beat(identity, Endpoint(7, THERE), t_s) == [False]
        assert beat(identity, Endpoint(1, THERE), t_s + 0.5) == [t_s >= 30]
        assert identity.has_moved == (t_s == 30)
    assert "for 30 s" in caplog.text
    assert beat(identity, Endpoint(1, HERE), 41.0) == [False]


def test_identity_keeps_a_configured_system_at_any_address(caplog):
    identity = Identity(system_id=1)
    assert not any(beat(identity, Endpoint(2, HERE), *list_seconds(0, 99)))
    assert identity.foreign_messages == 100
    assert caplog.text.count("system 1 ") == 1
    assert beat(identity, Endpoint(1, HERE), 100.0) == [True]
    assert not any(beat(identity, Endpoint(2, HERE), *list_seconds(101, 200)))
    assert beat(identity, Endpoint(1, THERE), 129.0, 130.0) == [False, True]
    assert identity.current == Endpoint(1, THERE)


def test_identity_ignores_a_second_sender_with_the_same_system_id(autopilot, caplog):
    autopilot.conversation.requests.is_flying = True
    autopilot.put_fix()
    for _ in range(40):
        autopilot.wait(1.0)
        autopilot.beat(address=THERE)
        answer = mavlink.MAVLink_command_ack_message(43003, 0, target_system=7, target_component=197)
        autopilot.send(answer, address=THERE)
        autopilot.send(mavlink.MAVLink_command_long_message(7, 197, 31010, 0, 1, 0, 0, 0, 0, 0, 0), 255, 190, THERE)
        autopilot.beat()
    assert autopilot.put_fix().sent
    assert autopilot.conversation.autopilot.acks == {}
    assert autopilot.conversation.requests.take() is None
    assert autopilot.conversation.autopilot.identity.foreign_messages == 120
    assert caplog.text.count("another autopilot") == 1


@pytest.mark.parametrize(("system_id", "sent"), [(2, None), (7, True)])
def test_link_sends_no_fix_after_a_reconnection_before_a_heartbeat(autopilot, system_id, sent):
    autopilot.conversation.handle_port_loss(0)
    autopilot.beat(system_id=system_id)
    sending = autopilot.conversation.send_fix(Fix(50.0, 8.0, 20.0, autopilot.clock.now_s))
    autopilot.take_sent()
    assert sending.sent is sent
