"""The link to the flight controller: any thread may call it, but only its own touches the socket or serial port."""

import logging
import select
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field

from edgevpr.core.errors import LinkError
from edgevpr.core.types import Vehicle
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.channel import Channel
from edgevpr.mavlink.conversation import Conversation, LinkSettings
from edgevpr.mavlink.fixes import Sending
from edgevpr.mavlink.ground import Wish, Wished
from edgevpr.mavlink.messages import Fix, Health, Severity
from edgevpr.mavlink.ports import Line, Port, open_port
from edgevpr.mavlink.signing import OLD
from edgevpr.mavlink.turns import Turns
from edgevpr.mavlink.wire import Message

SLEEP_S = 0.25  # of the thread, when nothing wakes it
RETRY_FIRST_S = 0.2
RETRY_MAX_S = 2.0
WATCH_S = 0.01  # between two checks whether a fix has left the operating system
FLUSH_S = 0.5

Step = Callable[..., None]  # records one event of a turn on the tape: its name, and its values

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStats:
    """Counts and state of a link since its start; messages are counted by name, answers (`acks`) by name of the result.

    `trouble` is why the port could not be opened or was lost; None once data arrives again. `foreign_messages` came
    from another autopilot or address. `withheld_fixes` were not sent because of unanswered ones or a pause;
    `refused_why` is about the last refused one. `commands` and `ignored_requests` count the requests on any link.
    `bad_bytes` belong to no message. `answered_s`: when a command of ours was last answered, by its number."""

    connected: bool
    trouble: str | None
    autopilot_heard: bool
    autopilot_system_id: int | None
    sent: dict[str, int]
    received: dict[str, int]
    acks: dict[str, int]
    dropped_stale_fixes: int
    withheld_fixes: int
    commands: dict[str, int]
    ignored_requests: int
    unanswered_fixes: int
    refused_why: str | None
    foreign_messages: int
    refused_signatures: dict[str, int]
    dropped_queue_full: int
    bad_bytes: int
    reopened: int
    used_share: float | None = None
    answered_s: dict[int, float] = field(default_factory=dict)

    @property
    def fixes_sent(self) -> int:
        return self.sent.get("COMMAND_INT", 0)

    @property
    def positions_sent(self) -> int:
        """The number of positions sent by message 296 or ODOMETRY."""
        return self.sent.get("GLOBAL_POSITION_SENSOR", 0) + self.sent.get("ODOMETRY", 0)


class Link:
    """The link to one flight controller. It sends, receives, and reopens the port whenever the connection is lost. Its
    `conversation` decides what is sent, and processes what is received; it is used inside `turns` only. Those of
    another link are shared if given; `converse` makes the conversation.

    All methods but `start` and `close` may be called from any thread; none waits for the other end, and none raises.
    Those that are not explained here are those of `Conversation`.
    """

    name = "link"

    def __init__(
        self,
        address: LinkAddress,
        settings: LinkSettings,
        turns: Turns | None = None,
        converse: type[Conversation] = Conversation,
    ) -> None:
        self._address, self._settings = address, settings
        self._tape = settings.tape
        self.turns = turns or Turns(settings.clock, settings.tape)
        with self.turn("begin"):
            self.conversation = converse(settings, self.turns.now_s)
        self._line: Line | None = None
        self._reopened = 0
        self._retry_s = RETRY_FIRST_S
        self._trouble: str | None = None
        self._closing = threading.Event()
        self._bell, self._bell_button = socket.socketpair()  # wakes the thread when there is something to send
        self._bell_button.setblocking(False)
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)

    def start(self) -> None:
        """Open the port and start the thread. Raises LinkError for a fault that only the user can correct. A missing
        device or server is no error: the thread tries to open it again and again, and `stats` gives the reason."""
        try:
            self._line = self._opened()
        except OSError as error:
            self._note_trouble(error)
        except LinkError:
            self.close()
            raise
        self._thread.start()

    def turn(self, what: str) -> AbstractContextManager[None]:
        """Take a turn: a context manager in which the link does nothing, and its time stands still (see `Turns`)."""
        return self.turns.taken(what)

    def send(self, *outgoing: Message) -> None:
        with self._sending("send"):
            self.conversation.send(*outgoing)

    def send_fix(self, fix: Fix) -> Sending:
        with self._sending("send_fix"):
            return self.conversation.send_fix(fix)

    def announce(self, severity: Severity, text: str, topic: str | None = None) -> None:
        with self._sending("announce"):
            self.conversation.announce(severity, text, topic)

    def offer(self, wishes: Collection[Wish]) -> None:
        with self.turn("offer"):
            self.conversation.requests.offered = wishes

    def take_between(self) -> list[Sending]:
        with self.turn("take_between"):
            return self.conversation.take_between()

    def take_wishes(self) -> tuple[Wished, ...]:
        with self.turn("take_wishes"):
            return self.conversation.requests.take()

    def set_health(self, health: Health) -> None:
        with self.turn("set_health"):
            self.conversation.set_health(health)

    def want_position(self) -> None:
        with self.turn("want_position"):
            self.conversation.want_position()

    def vehicle(self) -> Vehicle | None:
        """Return the autopilot's last report of its vehicle; None before the first, and if the last had no position."""
        with self.turn("vehicle"):
            return self.conversation.autopilot.vehicle

    def vehicle_at(self, t_mono_s: float) -> Vehicle | None:
        with self.turn("vehicle_at"):
            return self.conversation.vehicle_at(t_mono_s)

    @property
    def channel(self) -> Channel:
        return self.conversation.channel

    def listens(self) -> bool:
        """Return True if a fix can be sent now: the port is connected and the autopilot has been heard lately."""
        with self.turn("listens"):
            return self._tape.read("port", self._port)[0] and self.conversation.autopilot.listens(self.turns.now_s())

    def stats(self) -> LinkStats:
        with self.turn("stats"):
            said, autopilot, fixes = self.conversation, self.conversation.autopilot, self.conversation.fixes
            connected, trouble, reopened = self._tape.read("port", self._port)
            return LinkStats(
                connected=connected,
                trouble=trouble,
                autopilot_heard=autopilot.listens(self.turns.now_s()),
                autopilot_system_id=autopilot.system_id,
                sent=dict(said.sent),
                received=dict(said.reader.received),
                acks=dict(autopilot.acks),
                dropped_stale_fixes=fixes.dropped,
                withheld_fixes=fixes.withheld,
                commands=dict(said.requests.results),
                ignored_requests=said.requests.ignored,
                unanswered_fixes=fixes.unanswered,
                refused_why=fixes.refusal.brief if fixes.refusal else None,
                foreign_messages=autopilot.identity.foreign_messages,
                refused_signatures=dict(said.settings.signing.refused),
                dropped_queue_full=said.dropped_queue_full,
                bad_bytes=said.reader.bad_bytes,
                reopened=reopened,
                used_share=autopilot.px4.used_share,
                answered_s=dict(autopilot.answered_s),
            )

    def close(self) -> None:
        """Send what is queued, wait for the answers to fixes, both for half a second at most, and close the port."""
        with self.turn("close"):
            self.conversation.texts.hurry()
        self._closing.set()
        self._ring()
        if self._thread.ident is None:  # never started
            self._close_all()
        else:
            self._thread.join(2 * FLUSH_S)

    def __enter__(self) -> "Link":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _port(self) -> tuple[bool, str | None, int]:
        line = self._line
        return line is not None and line.port.connected, self._trouble, self._reopened

    def _opened(self) -> Line:
        return Line(open_port(self._address), self._settings.clock, self._settings.tap)

    # The methods below run in the link's own thread.

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                if self._line is None:
                    self._reopen()
                else:
                    self._work(self._line, timeout_s=SLEEP_S)
            except (OSError, LinkError) as error:
                self._lose(error)
            except Exception as error:  # a flight without a link is worse than one with a link opened anew
                log.exception("the link failed")
                self._lose(error)
        self._flush()
        self._close_all()

    def _reopen(self) -> None:
        if self._closing.wait(self._retry_s):
            return
        self._retry_s = min(2 * self._retry_s, RETRY_MAX_S)
        with self.turns.of_link(self.name) as step:
            self.conversation.fixes.drop_stale(self.turns.now_s())
            step("waits")
        self._line = self._opened()
        self._reopened += 1

    def _work(self, line: Line, timeout_s: float) -> None:
        """Write as much as the port accepts, wait until there is something to do or `timeout_s` is over, and read."""
        with self.turns.of_link(self.name) as step:
            if line.port.connected:
                self._transmit(line, step)
            self.conversation.announce_changes()
            step("answers")
        reading: list[Port | socket.socket] = [line.port, self._bell]
        writing = [line.port] if line.unsent else []
        timeout_s = min(timeout_s, WATCH_S) if line.leaving else self.conversation.wait_s(timeout_s)
        readable, _, _ = select.select(reading, writing, [], timeout_s)
        if self._bell in readable:
            self._bell.recv(4096)
        if line.port in readable:
            self._receive(line)

    def _receive(self, line: Line) -> None:
        data = line.port.read()
        if data:
            self._retry_s = RETRY_FIRST_S
            if self._trouble is not None:
                log.info("%s is back", self._address)
                self._trouble = None
        with self.turns.of_link(self.name) as step:
            self._note_departed(line, step)  # before its answer is read
            try:
                beats = self.conversation.hear(data, self.turns.now_s(), line.port.sender)
            finally:
                verdicts = self._settings.signing.take_verdicts()
                step("heard", data, line.port.sender, verdicts)
            # An autopilot whose clock is old, which has the key, learns the time from what we send it.
            is_behind = OLD in verdicts and not self.conversation.autopilot.listens(self.turns.now_s())
        if beats or is_behind:
            line.port.answer_sender()

    def _transmit(self, line: Line, step: Step) -> None:
        while True:
            # Before writing: what has waited too long must not be written on.
            self._note_departed(line, step)
            if not line.unsent:
                next_one = self.conversation.next_packet()
                step("said", next_one and next_one[0])
                if next_one is None:
                    return
                line.put(*next_one)
            line.write()
            if line.unsent:
                return

    def _note_departed(self, line: Line, step: Step) -> None:
        if departed := line.departed():
            step("departed", len(departed))
            self.conversation.note_departed(departed)

    def _lose(self, error: Exception) -> None:
        with self.turns.of_link(self.name) as step:
            step("lost", lost_fixes := self._close_line())
            self.conversation.break_off(lost_fixes)
        self._note_trouble(error)

    def _close_line(self) -> int:
        """Close the port, and return the number of fixes thrown away with it."""
        line, self._line = self._line, None
        return line.close() if line else 0

    def _note_trouble(self, error: Exception) -> None:
        reason = getattr(error, "strerror", None) or str(error)
        if reason != self._trouble:
            self._trouble = reason
            log.warning("%s is not there (%s); trying again", self._address, reason)

    def _flush(self) -> None:
        give_up_s = time.monotonic() + FLUSH_S
        with suppress(OSError):
            while self._line and self._line.port.connected and time.monotonic() < give_up_s:
                self._work(self._line, timeout_s=0.01)
                if not self.conversation.waits and self._line.is_idle:
                    break

    def _close_all(self) -> None:
        with self.turns.of_link(self.name) as step:
            step("closed", self._close_line())
            self.conversation.end()
        self._bell.close()
        self._bell_button.close()

    @contextmanager
    def _sending(self, what: str) -> Iterator[None]:
        """Context manager: take a turn, and wake the thread after it."""
        with self.turn(what):
            yield
        self._ring()

    def _ring(self) -> None:
        with suppress(OSError):  # it rings already, or the link is closed
            self._bell_button.send(b"!")
