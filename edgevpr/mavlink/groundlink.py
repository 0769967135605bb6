"""The second link, to a ground station. It gets copies of the status messages and texts of the first link, and never a
position fix. Used by the flight where `mavlink.ground` is set.

No message is forwarded: that would let a stranger on the ground speak to the flight controller.
"""

from collections.abc import Callable
from copy import copy

from edgevpr.mavlink.address import LinkAddress, Sender
from edgevpr.mavlink.conversation import Conversation, LinkSettings
from edgevpr.mavlink.fixes import Sending
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.wire import Message, mavlink

FOR_PEOPLE = frozenset(("STATUSTEXT", "NAMED_VALUE_FLOAT", "NAMED_VALUE_INT", "ONBOARD_COMPUTER_STATUS"))


class GroundLink(Link):
    """The link to the ground station, beside the link `flight` to the flight controller. It has its own thread and
    port, so that a lost ground station delays no fix, but shares the turns of `flight`."""

    name = "ground"

    def __init__(self, address: LinkAddress, flight: Link) -> None:
        told = flight._conversation
        settings = LinkSettings(
            component_id=told.settings.component_id,
            clock=told.settings.clock,
            signing=told.settings.signing.of_ground(),
            tape=told.settings.tape,
        )
        super().__init__(address, settings)
        self._turns = flight._turns
        with self.turn("ground link"):
            self._conversation = GroundConversation(told, settings, self._turns.now_s)
        told.copy_message = self._tell
        # Each link has its own queue of texts: while a link is lost, its texts wait.
        told.copy_text = self.announce

    def _tell(self, message: Message) -> None:
        if message.get_type() in FOR_PEOPLE:
            self.send(copy(message))  # packing changes a message, and the other thread packs it too


class GroundConversation(Conversation):
    """The conversation with a ground station: no sender is taken for the autopilot, and the requests of all obeyed."""

    def __init__(self, flight: Conversation, settings: LinkSettings, clock: Callable[[], float]) -> None:
        super().__init__(settings, clock)
        self.requests = flight.requests
        self._flight = flight

    def next_packet(self) -> tuple[bytes, Sending | None] | None:
        """Choose and pack the next message, with the health and the system id of the link to the flight controller."""
        self._health, self._health_set_s = self._flight._health, self._flight._health_set_s
        self._packer.srcSystem = self._flight._packer.srcSystem
        return super().next_packet()

    def hear(self, data: bytes, now_s: float, sender: Sender | None) -> bool:
        """Process bytes received at `now_s`. Returns True if a ground station, to be answered, beats in them."""
        beats = False
        for message in self.reader.feed(data, sender):
            beats |= message.get_type() == "HEARTBEAT" and message.type == mavlink.MAV_TYPE_GCS
            self._hear_request(message, now_s)
        return beats
