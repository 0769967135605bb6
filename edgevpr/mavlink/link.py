"""The link to the flight controller. Any thread may call it; only its driver accesses the port."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field

from edgevpr.core.types import Vehicle
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.channel import Channel
from edgevpr.mavlink.conversation import Conversation, LinkSettings
from edgevpr.mavlink.driver import DriverMaker, PortDriver
from edgevpr.mavlink.fixes import FixTransmission
from edgevpr.mavlink.ground import UserCommand
from edgevpr.mavlink.messages import Fix, Health, Severity
from edgevpr.mavlink.turns import Turns
from edgevpr.mavlink.wire import Message


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStats:
    """Counts and state of a link since its start. Messages are counted by name, answers (`acks`) by name of the result.

    `trouble`: why the port could not be opened or was lost; None once data arrives again. `foreign_messages`: messages
    from another autopilot or address. `withheld_fixes`: fixes not sent because of unanswered ones or a pause.
    `refused_why`: reason of the last refusal. `bad_bytes`: bytes outside any message. `answered_s`: time of
    the last answer to our commands, by number."""

    connected: bool
    trouble: str | None
    autopilot_heard: bool
    autopilot_system_id: int | None
    sent: dict[str, int]
    received: dict[str, int]
    acks: dict[str, int]
    dropped_stale_fixes: int
    withheld_fixes: int
    unanswered_fixes: int
    refused_why: str | None
    foreign_messages: int
    refused_signatures: dict[str, int]
    bad_bytes: int
    used_share: float | None = None
    answered_s: dict[int, float] = field(default_factory=dict)

    @property
    def fixes_sent(self) -> int:
        return self.sent.get("COMMAND_INT", 0)

    @property
    def positions_sent(self) -> int:
        """Number of positions sent as message 296 or ODOMETRY."""
        return self.sent.get("GLOBAL_POSITION_SENSOR", 0) + self.sent.get("ODOMETRY", 0)


class Link:
    """The link to one flight controller. Its `conversation` makes the messages to send and processes received ones; it
    is used only inside `turns`. `drive` makes the driver, which moves packets through the port.

    All methods except `start` and `close` may be called from any thread; they never wait for the other end, and never
    raise. Methods without a docstring are those of `Conversation`."""

    def __init__(
        self, address: LinkAddress, settings: LinkSettings, turns: Turns | None = None, drive: DriverMaker = PortDriver
    ) -> None:
        self.turns = turns or Turns(settings.clock)
        with self.take_turn("begin"):
            self.conversation = Conversation(settings, self.turns.now_s)
        self._driver = drive(address, self.conversation, self.turns)

    def start(self) -> None:
        """Open the port and start to send and receive. Raises LinkError for a fault that only the user can correct. A
        missing device or server is not such a fault: `stats` gives the reason."""
        self._driver.start()

    def take_turn(self, name: str) -> AbstractContextManager[None]:
        """Context manager: take exclusive use of the link, whose clock stands still meanwhile (see `Turns`)."""
        return self.turns.take_turn(name)

    def send(self, *outgoing: Message) -> None:
        with self._send_turn("send"):
            self.conversation.send(*outgoing)

    def send_fix(self, fix: Fix) -> FixTransmission:
        with self._send_turn("send_fix"):
            return self.conversation.send_fix(fix)

    def announce(self, severity: Severity, text: str, topic: str | None = None) -> None:
        with self._send_turn("announce"):
            self.conversation.announce(severity, text, topic)

    def accept_commands(self) -> None:
        with self.take_turn("offer"):  # recordings of earlier flights use this name, and that of `take_command`
            self.conversation.requests.is_flying = True

    def take_interim_fixes(self) -> list[FixTransmission]:
        with self.take_turn("take_between"):
            return self.conversation.take_interim_fixes()

    def take_command(self) -> tuple[UserCommand, str] | None:
        with self.take_turn("take_wishes"):
            return self.conversation.requests.take()

    def set_health(self, health: Health) -> None:
        with self.take_turn("set_health"):
            self.conversation.set_health(health)

    def request_position(self) -> None:
        with self.take_turn("want_position"):
            self.conversation.request_position()

    def vehicle(self) -> Vehicle | None:
        """Return the last report of the vehicle; None before the first one, or if the last one had no position."""
        with self.take_turn("vehicle"):
            return self.conversation.autopilot.vehicle

    def predict_vehicle(self, t_mono_s: float) -> Vehicle | None:
        with self.take_turn("vehicle_at"):
            return self.conversation.predict_vehicle(t_mono_s)

    @property
    def channel(self) -> Channel:
        return self.conversation.channel

    def is_alive(self) -> bool:
        """Return True if a fix can be sent now: the port is connected and the autopilot's heartbeat is recent."""
        with self.take_turn("listens"):
            return self._driver.state()[0] and self.conversation.autopilot.is_alive(self.turns.now_s())

    def stats(self) -> LinkStats:
        with self.take_turn("stats"):
            conversation, autopilot, fixes = self.conversation, self.conversation.autopilot, self.conversation.fixes
            connected, trouble = self._driver.state()
            return LinkStats(
                connected=connected,
                trouble=trouble,
                autopilot_heard=autopilot.is_alive(self.turns.now_s()),
                autopilot_system_id=autopilot.system_id,
                sent=dict(conversation.sent),
                received=dict(conversation.reader.received),
                acks=dict(autopilot.acks),
                dropped_stale_fixes=fixes.dropped,
                withheld_fixes=fixes.withheld,
                unanswered_fixes=fixes.unanswered,
                refused_why=fixes.refusal.code.summary if fixes.refusal else None,
                foreign_messages=autopilot.identity.foreign_messages,
                refused_signatures=dict(conversation.settings.signing.refused),
                bad_bytes=conversation.reader.bad_bytes,
                used_share=autopilot.px4.used_share,
                answered_s=dict(autopilot.answered_s),
            )

    def close(self) -> None:
        """Send queued messages and wait for answers to fixes, for at most half a second each, then close the port."""
        with self.take_turn("close"):
            self.conversation.texts.remove_pauses()
        self._driver.close()

    def __enter__(self) -> "Link":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _send_turn(self, name: str) -> Iterator[None]:
        """Context manager: take a turn, then wake the driver's thread."""
        with self.take_turn(name):
            yield
        self._driver.wake()
