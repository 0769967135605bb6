"""Stand-ins for time, a source of frames and a flight controller's link, for tests of what lies above them.

Each keeps the promises of the real thing, and `test_fakes.py` holds both to them."""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import numpy as np

from edgevpr.core.config import load_config
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Frame, Receiver, Vehicle
from edgevpr.frames.shot import Condition
from edgevpr.mavlink.channel import Channel
from edgevpr.mavlink.fixes import Fixes, FixTransmission
from edgevpr.mavlink.ground import UserCommand
from edgevpr.mavlink.link import LinkStats
from edgevpr.mavlink.messages import Fix, Health, Severity, make_status_text
from edgevpr.mavlink.peer import Listener
from edgevpr.mavlink.vehicle import Readiness
from edgevpr.runtime.flight.autopilot import AutopilotOutput
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.notifier import Notifier

_STATES = {
    Condition.LOST: "lost, reopening in 0.5 s",
    Condition.FROZEN: "frozen: the same picture keeps arriving",
    Condition.OPENING: "opening, no picture yet",
    Condition.ENDED: "ended",
}


class FakeClock:
    """A clock that moves when told to, and when somebody sleeps by it. Called, it is the monotonic clock; `schedule`
    lets things happen while somebody sleeps."""

    def __init__(self, now_s: float = 1000.0) -> None:
        self.now_s, self.cpu_s, self.thread_cpu_s = now_s, 7.0, 3.0
        self._events: list[tuple[float, Callable[[], object]]] = []
        self.clock = Clock(
            mono_s=self,
            wall_s=self,
            utc_s=self.utc_s,
            process_cpu_s=lambda: self.cpu_s,
            thread_cpu_s=lambda: self.thread_cpu_s,
            sleep=self.sleep,
        )

    def __call__(self) -> float:
        return self.now_s

    def utc_s(self) -> float:
        return 1.7e9 + self.now_s

    def schedule(self, t_s: float, act: Callable[[], object]) -> None:
        """Let `act` happen `t_s` seconds from now."""
        self._events = sorted([*self._events, (self.now_s + t_s, act)], key=lambda event: event[0])

    def sleep(self, seconds: float) -> None:
        self.now_s += max(0.0, seconds)
        while self._events and self._events[0][0] <= self.now_s + 1e-9:
            self._events.pop(0)[1]()

    def work(self, wall_s: float, cores: float = 1.0) -> None:
        """Let so many cores be busy for a while, the asking thread among them."""
        self.now_s += wall_s
        self.cpu_s += wall_s * cores
        self.thread_cpu_s += wall_s * min(cores, 1.0)


class FakeSource:
    """A camera or stream (`is_live`), or a recording, of the pictures given, as many frames as there are. Reading one
    is `work`. A picture may be a Frame, of which all is kept but the time."""

    step_s = None

    def __init__(
        self,
        pictures: Iterable[np.ndarray | Frame | Exception],
        clock: Callable[[], float],
        *,
        is_live: bool = True,
        work: Callable[[], None] = lambda: None,
    ) -> None:
        self._leave, self._clock, self._work = deque(pictures), clock, work
        self.is_live = is_live
        self.total = 0 if is_live else len(self._leave)
        self.dropped = 0 if is_live else None
        self.refused = {"damaged": 0, "patched": 0, "frozen": 0, "late": 0} if is_live else {"damaged": 0}
        self.latency_s = 0.0 if is_live else None
        self.is_lost = self.is_frozen = self.is_opening = False
        self._read = 0

    @property
    def ended(self) -> bool:
        return not self._leave

    @property
    def condition(self) -> Condition:
        is_in = {
            Condition.LOST: self.is_lost,
            Condition.FROZEN: self.is_frozen,
            Condition.OPENING: self.is_opening,
            Condition.ENDED: self.ended,
        }
        return next((condition for condition, is_so in is_in.items() if is_so), Condition.RUNNING)

    @property
    def state(self) -> str:
        return _STATES.get(self.condition, "streaming" if self.is_live else "reading")

    def read(self, timeout_s: float) -> Frame | None:
        if not self._leave:
            return None
        self._work()
        picture = self._leave.popleft()
        if isinstance(picture, Exception):
            raise picture
        if not isinstance(picture, Frame):
            picture = Frame(image=picture, name=f"frame {self._read:06d}", t_mono_s=0.0)
        self._read += 1
        return replace(picture, t_mono_s=self._clock())

    def close(self) -> None:
        self._leave.clear()


def make_output(
    link, navigator, clock: "FakeClock", flight_log: FlightLog | None = None, **settings
) -> AutopilotOutput:
    """An autopilot at a link, with keys of the section `mavlink`."""
    config = load_config(None, {f"mavlink.{key}": value for key, value in settings.items()}).mavlink
    notifier = Notifier(flight_log or FlightLog(None), link)
    return AutopilotOutput(link, navigator, notifier, settings=config, cores=4, clock=clock.clock)


class FakeLink:
    """A link of which nothing gets lost, to an autopilot that listens from when it has an `answer` to fixes (None: it
    is not there) and says what `report_vehicle` gives (None: that it has no position). `sent` is what has left, in
    order; no text waits for its turn. `wish` stands for a command of the ground, which gets its answer."""

    def __init__(
        self,
        clock: Callable[[], float],
        *,
        answer: str | None = "ACCEPTED",
        vehicle: Callable[[], Vehicle | None] = lambda: None,
    ) -> None:
        self.answer, self.report_vehicle, self.sent = answer, vehicle, []
        self.listener = Listener()
        self.health = Health.BOOT
        self._clock = clock
        self._waiting = Fixes()
        self._fixes: list[Fix] = []
        self._acks: Counter[str] = Counter()
        self._is_under_way, self._wish = False, None

    def take_turn(self, name: str) -> AbstractContextManager[None]:
        if self.is_alive() and self.report_vehicle() is None:
            self.listener.handle_no_position(self._clock())
        return nullcontext()

    def send(self, *outgoing) -> None:
        self.sent += outgoing

    def send_fix(self, fix: Fix) -> FixTransmission:
        sending = self._waiting.put(fix, self._clock())
        self._turn()
        return sending

    def announce(self, severity: Severity, text: str, topic: str | None = None) -> None:
        self.send(make_status_text(severity, f"edgevpr: {text}"))

    def accept_commands(self) -> None:
        self._is_under_way = True

    def take_interim_fixes(self):
        return []

    def take_command(self) -> tuple[UserCommand, str] | None:
        wish, self._wish = self._wish, None
        return wish

    def send_command(self, wish: UserCommand) -> str:
        if not self._is_under_way:
            return "TEMPORARILY_REJECTED"
        self._wish = wish, "255/190"
        return "ACCEPTED"

    def set_health(self, health: Health) -> None:
        self.health = health

    def request_position(self) -> None:
        pass

    def vehicle(self) -> Vehicle | None:
        return self.report_vehicle() if self.is_alive() else None

    def predict_vehicle(self, t_mono_s: float) -> Vehicle | None:
        vehicle = self.vehicle()
        if vehicle is None:
            return None
        vehicle = replace(vehicle, t_fix_s=self._waiting.t_fix_s)
        self.listener.handle_vehicle(vehicle)
        return vehicle

    @property
    def channel(self) -> Channel:
        return Channel.COMMAND

    def is_alive(self) -> bool:
        return self.answer is not None

    def stats(self) -> LinkStats:
        self._turn()
        sent = Counter(message.get_type() for message in self.sent) | Counter(COMMAND_INT=len(self._fixes))
        return LinkStats(
            connected=True,
            trouble=None,
            autopilot_heard=self.is_alive(),
            autopilot_system_id=1 if self.is_alive() else None,
            sent=dict(sent),
            received={},
            acks=dict(self._acks),
            dropped_stale_fixes=self._waiting.dropped,
            withheld_fixes=self._waiting.withheld,
            unanswered_fixes=self._waiting.unanswered,
            refused_why=self._waiting.refusal and self._waiting.refusal.code.summary,
            foreign_messages=0,
            refused_signatures={},
            bad_bytes=0,
        )

    def texts(self) -> list[tuple[int, str]]:
        """Severity and text of every announcement."""
        return [(each.severity, each.text) for each in self.sent if each.get_type() == "STATUSTEXT"]

    def close(self) -> None:
        pass

    def _turn(self) -> None:
        if not self.is_alive():
            self._waiting.drop_stale(self._clock())
            return
        while (sending := self._waiting.next(self._clock())) is not None:
            self._fixes.append(sending.fix)
            self._waiting.record_sent(sending, self._clock())
            sending.settle(True)
            self._waiting.handle(self.answer, Readiness(has_gps=True).explain(self.answer), self._clock())
            self._acks[self.answer] += 1


def format_note(code: ReasonCode, **parameters: float) -> str:
    """Return the text with which a reason is announced to the ground station."""
    return f"edgevpr: {Reason(code, parameters)}"


def make_receiver(at_deg: tuple[float, float], sd_m: float, t_s: float, **other) -> Receiver:
    """What a GPS receiver reports that is there."""
    return Receiver(lat_deg=at_deg[0], lon_deg=at_deg[1], sd_m=sd_m, t_s=t_s, **other)


def make_vehicle(lat_deg: float, lon_deg: float, t_received_s: float, **other) -> Vehicle:
    """What an autopilot says that is there."""
    known = {"alt_m": 300.0, "heading_deg": None, "has_gps": True} | other
    known.setdefault("gps", make_receiver((lat_deg, lon_deg), 1.0, t_received_s) if known["has_gps"] else None)
    return Vehicle(lat_deg=lat_deg, lon_deg=lon_deg, t_received_s=t_received_s, **known)
