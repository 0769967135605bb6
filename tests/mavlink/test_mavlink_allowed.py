"""The list of what may be asked, as a function: whatever a message holds, there is a reaction, and it can be sent."""

import itertools
import math

from edgevpr.mavlink.allowed import IGNORED, SHORTEST_S, reaction, version
from edgevpr.mavlink.messages import Health, heartbeat
from edgevpr.mavlink.wire import Receiver, mavlink
from edgevpr.mavlink.wishes import Wish

US = (1, 197)
KNOWN = {0: lambda: heartbeat(Health.ACTIVE), 148: version, 390: lambda: None}
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
    (arrived,) = Receiver().feed(message.pack(mavlink.MAVLink(None, *sender)))
    return arrived


def react(message, offered=tuple(Wish)):
    return reaction(message, US, 5.0, offered, KNOWN)


def test_whatever_a_command_holds_it_has_one_answer_that_can_be_sent():
    for command, p1, p2, sender in itertools.product((31010, 511, 512), ODD, ODD, SENDERS):
        message = heard(mavlink.MAVLink_command_long_message(*US, command, 255, p1, p2, *[math.nan] * 5), sender)
        found = react(message)
        ack, *others = (heard(reply, US) for reply in found.replies)
        assert (ack.get_type(), ack.command, ack.result) == ("COMMAND_ACK", command, found.result)
        assert (ack.target_system, ack.target_component) == sender
        assert (found.wish is not None) == (command == 31010 and found.result == 0)
        assert (found.interval is not None) == (command == 511 and found.result == 0)
        assert len(others) == (command == 512 and found.result == 0)
        if found.interval and found.interval[1] is not None:
            number, interval_s = found.interval
            assert interval_s >= SHORTEST_S[number]


def test_every_other_command_is_unsupported():
    for command in set(range(65_536)) - {31010, 511, 512}:
        message = mavlink.MAVLink_command_long_message(*US, command, 0, 1, 1, 0, 0, 0, 0, 0)
        message._header.srcSystem, message._header.srcComponent = 255, 190
        found = react(message)
        assert (found.result, len(found.replies)) == (mavlink.MAV_RESULT_UNSUPPORTED, 1)
        assert (found.wish, found.interval) == (None, None)


def test_of_all_other_messages_those_that_are_for_us_are_ignored_and_those_that_are_not_do_not_concern_us():
    concerned = 0
    for kind in mavlink.mavlink_map.values():
        values = {
            name: US[0] if name == "target_system" else US[1] if name == "target_component" else 0
            for name in kind.fieldnames
        }
        message = kind.__new__(kind)
        for name, value in values.items():
            setattr(message, name, value)
        message._type, message._header = kind.msgname, mavlink.MAVLink_header(kind.id, srcSystem=255, srcComponent=190)
        if kind.msgname in ("COMMAND_LONG", "COMMAND_INT", "PING", "TIMESYNC", "COMMAND_ACK"):
            continue
        is_for_us = {"target_system", "target_component"} <= set(kind.fieldnames)
        assert react(message) is (IGNORED if is_for_us else None), kind.msgname
        concerned += is_for_us
    assert concerned > 30
