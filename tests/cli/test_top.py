"""The words of `edgevpr top`."""

from dataclasses import replace

from edgevpr.cli.top import rows
from edgevpr.mavlink.channel import Channel
from tests.runtime.statuses import LINK, STATUS


def test_the_channel_is_called_as_documents_call_it():
    said = {
        channel: dict(rows(replace(STATUS, link=replace(LINK, channel=channel.name))))["link"] for channel in Channel
    }
    assert said[Channel.COMMAND].endswith("told by command 43003")
    assert said[Channel.SENSOR].endswith("told by message 296")
    assert said[Channel.GPS_INPUT].endswith("told by GPS_INPUT")
    assert said[Channel.ODOMETRY].endswith("told by ODOMETRY")
