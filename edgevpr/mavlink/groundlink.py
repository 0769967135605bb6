"""The second link, to a ground station: what the first one says to people is said there too, and never a fix.

Nothing is forwarded from one link to the other. That is a router's work: here it would let a stranger on the ground
speak to the flight controller.
"""

import math
import time
from collections.abc import Callable
from copy import copy

from edgevpr.mavlink.address import LinkAddress, Sender
from edgevpr.mavlink.conversation import Conversation, LinkSettings
from edgevpr.mavlink.fixes import Sending
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.requests import Requests
from edgevpr.mavlink.wire import Message, mavlink

FOR_PEOPLE = frozenset(("STATUSTEXT", "NAMED_VALUE_FLOAT", "NAMED_VALUE_INT", "ONBOARD_COMPUTER_STATUS"))
# Of two stations at one listening port, the first is answered for as long as it beats; it does so once a second.
SILENT_AFTER_S = 5.0


class GroundLink(Link):
    """The link to the ground beside the one to the `flight` controller. It has the same identity and health, and its
    own thread and port, so that a ground station that is lost holds up no fix; the turns it shares."""

    name = "ground"

    def __init__(self, address: LinkAddress, flight: Link, clock: Callable[[], float] = time.monotonic) -> None:
        told = flight._conversation
        signing = told.settings.signing.of_ground()
        settings = LinkSettings(
            component_id=told.settings.component_id, max_fix_age_s=0.0, clock=clock, signing=signing, tape=flight._tape
        )
        super().__init__(address, settings)
        self._turns = flight._turns
        with self.turn("ground link"):
            self._conversation = GroundConversation(told, settings, self._turns.now_s)
        told.copy_message = self._tell
        # Texts wait for their turn on each link by itself: on one that is lost they wait for ever.
        told.copy_text = self.announce

    def _tell(self, message: Message) -> None:
        if message.get_type() in FOR_PEOPLE:
            self.send(copy(message))  # packing changes a message, and the other thread packs it too


class GroundConversation(Conversation):
    """The conversation with a ground station: heartbeats and what is queued. Nobody who is heard is an autopilot."""

    def __init__(self, flight: Conversation, settings: LinkSettings, clock: Callable[[], float]) -> None:
        super().__init__(settings, clock)
        self.wishes, self.requests = flight.wishes, Requests(flight.wishes)
        self._flight = flight
        self._station: Sender | None = None
        self._station_heard_s = -math.inf

    def next_packet(self) -> tuple[bytes, Sending | None] | None:
        """Choose and pack the next message, as the vehicle that the flight controller says we are."""
        self._health, self._health_set_s = self._flight._health, self._flight._health_set_s
        self._packer.srcSystem = self._flight._packer.srcSystem
        return super().next_packet()

    def hear(self, data: bytes, now_s: float, sender: Sender | None) -> bool:
        """Take in bytes that arrived from `sender`; return True where they hold a heartbeat of the ground station that
        is answered. Whatever else is to be heard on the ground's link is heard here."""
        beats = False
        for message in self.reader.feed(data, sender):
            if message.get_type() == "HEARTBEAT" and message.type == mavlink.MAV_TYPE_GCS:
                beats |= self._is_answered(sender, now_s)
            self._hear_request(message, now_s)
        return beats

    def _is_answered(self, sender: Sender | None, now_s: float) -> bool:
        if sender != self._station and now_s - self._station_heard_s <= SILENT_AFTER_S:
            return False
        self._station, self._station_heard_s = sender, now_s
        return True
