"""Requests an autopilot's version and parameters in flight, and chooses the channel for positions accordingly."""

import logging
import math
from collections import Counter
from collections.abc import Iterator

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink import messages
from edgevpr.mavlink.ardupilot_parameters import ARDUPILOT_TABLE
from edgevpr.mavlink.channel import Channel, ChannelChoice, VehicleKind, classify_vehicle
from edgevpr.mavlink.ground import Announce
from edgevpr.mavlink.parameters import ALTERNATIVES, Decision, ParameterTable
from edgevpr.mavlink.px4_parameters import PX4_TABLE
from edgevpr.mavlink.wire import Message, mavlink, read_parameter_value

MAX_PARALLEL_REQUESTS = 10  # ArduPilot drops requests beyond 20 (GCS_Param.cpp, param_requests)
ROUND_INTERVAL_S = 1.0
MIN_ROUND_INTERVAL_S = 0.1  # after a round with an answer to every request
MAX_SILENT_ROUNDS = 4  # after this many rounds without any answer, the pauses grow
MAX_PAUSE_S = 30.0
REFRESH_INTERVAL_S = 2.0  # between repeated requests of known parameters, to detect changes in flight
MIN_ROUNDS_TO_ABSENT = 4
MAX_LOSS_PROBABILITY = 1e-4  # probability that all answers for one parameter were lost
MISSING_REPORT_DELAY_S = 10.0
MAX_VERSION_REQUESTS = 4
TOPIC = "parameters"

TABLES = {mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: ARDUPILOT_TABLE, mavlink.MAV_AUTOPILOT_PX4: PX4_TABLE}
_DEFAULT_CHOICE = ChannelChoice(Channel.COMMAND, Reason(ReasonCode.COMMAND_TO_ANY))
_EMPTY_TABLE = ParameterTable("unknown firmware", (), (), lambda _kind, _parameters: _DEFAULT_CHOICE)

log = logging.getLogger(__name__)


class ChannelSelector:
    """Requests an autopilot's version and the parameters of its table, and chooses the channel.

    Unanswered requests are repeated after a second or, while no request is answered, after growing pauses. Known
    parameters are requested again, one every two seconds, and values that arrive unrequested are also used. After a
    change the channel is chosen again. Old firmware does not answer requests for a parameter that it lacks. Such a
    parameter counts as absent after four rounds with answers for others, or more on a link that loses messages.

    `version`: (major, minor) of the firmware (None: unknown). `choice`: the channel. Before the first requests it is
    command 43003, for programs that only send fixes and need no reports. Then it is `Channel.NONE` until all parameters
    that determine it are known."""

    def __init__(self, announce: Announce) -> None:
        self._announce = announce
        self._values: dict[str, float] = {}
        self._decision = Decision(_DEFAULT_CHOICE)
        self._reported: Decision | None = None
        self._autopilot, self._kind = int(mavlink.MAV_AUTOPILOT_GENERIC), VehicleKind.OTHER
        self.version: tuple[int, int] | None = None
        self._version_requests = 0
        self._absent: set[str] = set()
        self._requests: Counter[str] = Counter()
        self._unanswered: Counter[str] = Counter()  # rounds with an answer for another name, but not for this one
        self._pending: set[str] = set()  # names requested in the last round, and not yet answered
        self._answers = 0
        self._silent_rounds = self._refresh_index = 0
        self._requested_s = self._due_s = -math.inf
        self._has_begun = self._is_incomplete = False  # the first requests were made; answers are still missing
        self._missing_since_s: float | None = None
        self._has_reported_missing = False

    @property
    def choice(self) -> ChannelChoice:
        return self._decision.choice

    def handle(self, message: Message) -> None:
        """Process a message from the autopilot; irrelevant kinds are ignored."""
        match message.get_type():
            case "HEARTBEAT":
                previous = self._autopilot, self._kind
                self._autopilot, self._kind = message.autopilot, classify_vehicle(message.type)
                if previous != (self._autopilot, self._kind):
                    self._decide()
            case "AUTOPILOT_VERSION":
                self.version = message.flight_sw_version >> 24 & 255, message.flight_sw_version >> 16 & 255
            case "PARAM_VALUE" if message.param_id in self._table.all_names:
                value = read_parameter_value(message, bytewise=self._autopilot == mavlink.MAV_AUTOPILOT_PX4)
                if value is not None:
                    self._handle_value(message.param_id, value)
            case "PARAM_ERROR" if message.error == mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST:
                if message.param_id in self._table.all_names and message.param_id not in self._values:
                    self._record_answer(message.param_id)
                    self._absent.add(message.param_id)
                    self._decide()

    def make_requests(self, now_s: float, target_system: int) -> Iterator[Message]:
        """Yield the requests that are due at `now_s`."""
        if not self._has_begun:
            self._has_begun = True
            self._decide()
        self._report_missing(now_s)
        if now_s < self._due_s:
            return
        if self._silent_rounds == 0 and self._pending:
            self._unanswered.update(self._pending)
            self._mark_absent()
        missing = self._find_missing()
        names = missing[: MAX_PARALLEL_REQUESTS - 1]
        names += self._choose_refresh(is_only_request=not missing)
        wants_version = self.version is None and self._version_requests < MAX_VERSION_REQUESTS
        self._is_incomplete = bool(missing) or wants_version
        self._pending, self._requested_s = set(names), now_s
        self._requests.update(names)
        self._silent_rounds += 1
        doublings = min(8, max(0, self._silent_rounds - MAX_SILENT_ROUNDS))
        pause_s = min(MAX_PAUSE_S, ROUND_INTERVAL_S * 2**doublings)
        self._due_s = now_s + (pause_s if self._is_incomplete else REFRESH_INTERVAL_S)
        if wants_version:
            self._version_requests += 1
            yield messages.make_message_request(target_system, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        for name in names:
            yield messages.make_parameter_request(target_system, name)

    def _handle_value(self, name: str, value: float) -> None:
        self._record_answer(name)
        previous = self._values.get(name)
        self._values[name] = value
        self._absent.discard(name)
        if value != previous:
            self._decide()

    def _record_answer(self, name: str) -> None:
        """Record an answer for one parameter, which proves that the autopilot receives our requests."""
        self._version_requests *= bool(self._values)
        self._silent_rounds = 0
        self._answers += name in self._pending
        self._pending.discard(name)
        if self._is_incomplete:
            interval_s = ROUND_INTERVAL_S if self._pending else MIN_ROUND_INTERVAL_S
            self._due_s = min(self._due_s, self._requested_s + interval_s)

    def _mark_absent(self) -> None:
        """Mark parameters as absent if, given the fraction of answers that arrive, it is almost impossible that all
        their answers were lost. Each other parameter that may be absent counts as one lost answer."""
        unknown = {name for name in self._unanswered.keys() - self._values.keys() if not self._is_known(name)}
        lost_answers = sum(self._unanswered[name] for name in self._values) + len(unknown - self._absent)
        answer_probability = (self._answers + 1) / (self._answers + lost_answers + 2)
        rounds = max(MIN_ROUNDS_TO_ABSENT, math.log(MAX_LOSS_PROBABILITY) / math.log(1 - answer_probability))
        absent = {name for name in unknown - self._absent if self._unanswered[name] >= rounds}
        if absent:
            self._absent |= absent
            self._decide()

    @property
    def _table(self) -> ParameterTable:
        return TABLES.get(self._autopilot, _EMPTY_TABLE)

    def _is_known(self, name: str) -> bool:
        names = {name, ALTERNATIVES.get(name) or name}
        return not names.isdisjoint(self._values) or names <= self._absent

    def _find_missing(self) -> list[str]:
        """Return the names to request: those that determine the channel, then those that it requires, then the rest,
        in each group those requested least often first. An alternative name is requested if the first has no answer."""
        table = self._table
        needed = table.list_needed(table.choose(self._kind, self._values))
        rank = dict.fromkeys(needed, 1) | dict.fromkeys(table.deciding, 0)
        missing: list[tuple[int, int, str]] = []
        for name in table.names:
            if not self._is_known(name):
                alternative = ALTERNATIVES.get(name)
                names = (name, alternative) if alternative and self._requests[name] else (name,)
                missing += [(rank.get(name, 2), self._requests[key], key) for key in names if key not in self._absent]
        return [name for *_, name in sorted(missing)]

    def _choose_refresh(self, is_only_request: bool) -> list[str]:
        """Return the name to request again, if any: a known one or, if it is the only request, also an absent one,
        because all its answers may have been lost."""
        names = list(self._values)
        if is_only_request:
            names += [name for name in self._absent if ALTERNATIVES.get(name) not in self._values]
        self._refresh_index += 1
        return [sorted(names)[self._refresh_index % len(names)]] if names else []

    def _decide(self) -> None:
        """Choose the channel again, and report it if the decision has changed."""
        if not self._has_begun:
            return
        self._decision = decision = self._table.decide(self._kind, self._values, self._is_known)
        if not decision.missing and decision != self._reported:
            self._report(decision)
            self._reported = decision

    def _report(self, decision: Decision) -> None:
        version = f" {self.version[0]}.{self.version[1]}" if self.version else ""
        vehicle, choice = f"{self._table.name}{version} on a {self._kind.value}", decision.choice
        faults = list(decision.faults)
        if choice.channel is Channel.NONE:
            log.warning("%s: %s", vehicle, choice.reason)
            self._announce(messages.Severity.WARNING, f"nothing sent: {faults.pop(0).brief}", TOPIC)
        else:
            log.info("%s: sending positions via %s", vehicle, choice.reason)
            if faults:
                self._announce(messages.Severity.WARNING, f"{faults[0].brief}: see the log", TOPIC)
            elif self._reported or self._has_reported_missing:
                self._announce(messages.Severity.INFO, f"positions sent via {choice.channel.name}", TOPIC)
        for fault in faults:
            log.warning("%s", fault.reason)

    def _report_missing(self, now_s: float) -> None:
        missing = self._decision.missing
        if not missing:
            self._missing_since_s = None
        elif self._missing_since_s is None:
            self._missing_since_s, self._has_reported_missing = now_s, False
        elif not self._has_reported_missing and now_s - self._missing_since_s >= MISSING_REPORT_DELAY_S:
            self._has_reported_missing = True
            log.warning("%s", self._decision.choice.reason)
            more = f" and {len(missing) - 1} more" if missing[1:] else ""
            self._announce(messages.Severity.WARNING, f"no answer for {missing[0]}{more}", TOPIC)
