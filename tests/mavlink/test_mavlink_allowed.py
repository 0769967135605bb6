"""The list of what may be asked, as a function: whatever a message holds, there is a reaction, and it can be sent."""

import itertools
import math

from edgevpr.mavlink.messages import Health, heartbeat
from edgevpr.mavlink.requests import SHORTEST_S, Requests, Wish, Wishes
from edgevpr.mavlink.wire import PacketReader, mavlink

US = (1, 197)
ODD = (
    math.nan,
    math.inf,
    -math.inf,
    -0.0,
    -1.0,
    1e-45,
    0.5,
    1.0,
    3.0,
    4.5,
    148.0,
    251.0,
    390.0,
    1e6,
    2**31,
    2.0**64,
    3e38,
)
SENDERS = ((255, 190), (1, 1), (255, 0))


def heard(message, sender=(255, 190)):
    """A message as it arrives."""
    (arrived,) = PacketReader().feed(message.pack(mavlink.MAVLink(None, *sender)))
    return arrived


def react(message, offered=tuple(Wish)):
    """The replies to a message, the requests that it has met, and the wishes."""
    wishes = Wishes()
    wishes.offered = offered
    requests = Requests(wishes)
    return requests.hear(message, US, 5.0, lambda: heartbeat(Health.ACTIVE)), requests, wishes.take()


def test_whatever_a_command_holds_it_has_one_answer_that_can_be_sent():
    for command, p1, p2, sender in itertools.product((31010, 511, 512), ODD, ODD, SENDERS):
        message = heard(mavlink.MAVLink_command_long_message(*US, command, 255, p1, p2, *[math.nan] * 5), sender)
        replies, requests, wishes = react(message)
        ack, *others = (heard(reply, US) for reply in replies)
        assert (ack.get_type(), ack.command) == ("COMMAND_ACK", command)
        assert (ack.target_system, ack.target_component) == sender
        assert bool(wishes) == (command == 31010 and ack.result == 0)
        assert bool(requests._intervals_s) == (command == 511 and ack.result == 0)
        assert len(others) == (command == 512 and ack.result == 0)
        assert all(each == 0 or each >= SHORTEST_S[number] for number, each in requests._intervals_s.items())


def test_every_other_command_is_unsupported():
    requests = Requests(Wishes())
    for second, command in enumerate(sorted(set(range(65_536)) - {31010, 511, 512})):
        message = mavlink.MAVLink_command_long_message(*US, command, 0, 1, 1, 0, 0, 0, 0, 0)
        message._header.srcSystem, message._header.srcComponent = 255, 190
        (ack,) = requests.hear(message, US, float(second), lambda: heartbeat(Health.ACTIVE))
        assert ack.result == mavlink.MAV_RESULT_UNSUPPORTED
    assert set(requests.results) == {"UNSUPPORTED"}


def test_of_all_other_messages_those_that_are_for_us_are_ignored_and_those_that_are_not_do_not_concern_us():
    concerned = 0
    for kind in mavlink.mavlink_map.values():
        message = kind.__new__(kind)
        for name in kind.fieldnames:
            setattr(message, name, {"target_system": US[0], "target_component": US[1]}.get(name, 0))
        message._type, message._header = kind.msgname, mavlink.MAVLink_header(kind.id, srcSystem=255, srcComponent=190)
        if kind.msgname in ("COMMAND_LONG", "COMMAND_INT", "PING", "TIMESYNC", "COMMAND_ACK"):
            continue
        is_for_us = {"target_system", "target_component"} <= set(kind.fieldnames)
        replies, requests, _ = react(message)
        assert (replies, requests.ignored) == ((), is_for_us), kind.msgname
        concerned += is_for_us
    assert concerned > 30
