"""The second link, to a ground station. It gets copies of the status messages and texts of the first link, and never a
position fix. Used by the flight where `mavlink.ground` is set.

No message is forwarded: that would let a stranger on the ground speak to the flight controller.
"""

from edgevpr.mavlink.address import LinkAddress, Sender
from edgevpr.mavlink.conversation import Conversation, LinkSettings
from edgevpr.mavlink.driver import DriverMaker, PortDriver
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.wire import mavlink


class GroundConversation(Conversation):
    """The conversation with a ground station: no sender is taken for the autopilot, and the requests of all obeyed."""

    def handle(self, data: bytes, now_s: float, sender: Sender | None) -> bool:
        """Process bytes received at `now_s`. Returns True if a ground station, to be answered, beats in them."""
        beats = False
        for message in self.reader.feed(data, sender):
            beats |= message.get_type() == "HEARTBEAT" and message.type == mavlink.MAV_TYPE_GCS
            self._handle_request(message, now_s)
        return beats


class GroundLink(Link):
    """The link to the ground station, beside the link `flight` to the flight controller. It has its own thread and
    port, so that a lost ground station delays no fix, but shares the turns of `flight`."""

    name = "ground"

    def __init__(self, address: LinkAddress, flight: Link, drive: DriverMaker = PortDriver) -> None:
        of_flight = flight.conversation.settings
        settings = LinkSettings(
            component_id=of_flight.component_id,
            clock=of_flight.clock,
            signing=of_flight.signing.make_gcs_signing(),
        )
        super().__init__(address, settings, flight.turns, converse=GroundConversation, drive=drive)
        with self.turn("ground link"):
            flight.conversation.copy_to(self.conversation)
