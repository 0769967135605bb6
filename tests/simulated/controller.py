"""A simulated flight controller: the messages that it understands, obeys and sends. It has no port and no clock; time
is an argument, in seconds from its start. Used by `autopilot` and by tests."""

import math
from collections.abc import Callable

from edgevpr.mavlink.messages import AUTOPILOT
from edgevpr.mavlink.wire import Message, mavlink
from simulated.ardupilot_rules import ArduPilot
from simulated.firmware import DENIED, FAILED, OK, UNSUPPORTED, Firmware
from simulated.motion import Motion
from simulated.px4_rules import Px4
from simulated.reports import FILTER_REPORTS, REPORTS, Report

STEP_S = 0.04
VEHICLES: dict[str, Callable[[Motion], Firmware]] = {
    "arducopter": lambda motion: ArduPilot("copter", motion),
    "arduplane": lambda motion: ArduPilot("plane", motion),
    "px4-copter": lambda motion: Px4("copter", motion),
    "px4-plane": lambda motion: Px4("plane", motion),
}
_HEARTBEAT_HZ = 1.0
_UNKNOWN_WIND_M_S = 6.0


class FlightController:
    """A simulated vehicle, one of VEHICLES, that moves by `motion`. Without `gps` it has lost GPS in flight, before the
    start; with it, it loses GPS `gps_until_s` seconds after the start of its track, as a wind of 6 m/s comes up that it
    does not know. `start_utc_s` is its UTC at the start, seconds since 1970. `answers` are the replies (MAV_RESULT)
    to the fixes received, and `reports` make its messages, by message number. `brain` is the simulated firmware."""

    system_id = 1

    def __init__(
        self,
        vehicle: str,
        motion: Motion,
        *,
        gps: bool,
        gps_until_s: float = math.inf,
        start_utc_s: float = 1_770_000_000.0,
    ) -> None:
        self.brain = VEHICLES[vehicle](motion)
        self.brain.start_utc_s = start_utc_s
        self.vehicle, self._gps_until_s = vehicle, gps_until_s
        self.answers: list[int] = []
        filter_report = self.brain.filter_report
        self.reports: dict[int, Report] = {**REPORTS, filter_report: FILTER_REPORTS[filter_report]}
        often_hz = {mavlink.MAVLINK_MSG_ID_HEARTBEAT: _HEARTBEAT_HZ, **self.brain.default_hz}
        self._default_s = {number: 1 / hz for number, hz in often_hz.items()}
        self._interval_s = dict(self._default_s)
        self._due_s = dict.fromkeys(self._interval_s, 0.0)
        if not gps:
            self.brain.lose_gps()

    def __str__(self) -> str:
        gps = "with GPS" if self.brain.parameters["SIM_GPS1_ENABLE"] else "that has lost GPS"
        return f"a simulated {self.vehicle} {gps}, system {self.system_id},"

    @property
    def error_m(self) -> float:
        """Distance in metres between the estimated and the true position."""
        return abs(self.brain.estimator.error_m)

    def set(self, name: str, value: float) -> None:
        """Set a parameter, as PARAM_SET does. For example, SIM_GPS1_ENABLE 0 switches GPS off."""
        self.brain.parameters.set(name, value)

    def advance(self, now_s: float) -> list[Message]:
        """Simulate up to `now_s` in steps of STEP_S seconds; return the messages sent meanwhile."""
        messages = []
        while self.brain.now_s + STEP_S <= now_s:
            self.brain.step(STEP_S)
            if self.brain.truth.t_s >= self._gps_until_s:
                self._gps_until_s = math.inf
                self.set("SIM_GPS1_ENABLE", 0)
                self.set("SIM_WIND_SPD", _UNKNOWN_WIND_M_S)
            for number, interval_s in self._interval_s.items():
                if self.brain.now_s >= self._due_s[number]:
                    self._due_s[number] = max(self._due_s[number] + interval_s, self.brain.now_s)
                    messages += self._make(number)
        return messages

    def receive(self, message: Message) -> list[Message]:
        """Process a received message; return the replies."""
        is_ours = getattr(message, "target_system", 0) in (0, self.system_id)
        if not is_ours or getattr(message, "target_component", 0) not in (0, AUTOPILOT):
            return []
        brain = self.brain
        match message.get_type():
            case "COMMAND_INT" | "COMMAND_LONG":
                result, answers = self._obey(message)
                sender = {"target_system": message.get_srcSystem(), "target_component": message.get_srcComponent()}
                return [mavlink.MAVLink_command_ack_message(message.command, result, **sender), *answers]
            case "PARAM_REQUEST_READ" | "PARAM_SET":
                return brain.parameters.answer(message)
            case "TIMESYNC" if message.tc1 == 0:
                return [mavlink.MAVLink_timesync_message(round(brain.now_s * 1e9) + 1, message.ts1)]
            case "GPS_INPUT":
                brain.receivers.receive(message, brain.now_s)
            case "ODOMETRY":
                brain.take_odometry(message)
            case "GLOBAL_POSITION_SENSOR":
                brain.take_global_position(message)
        return []

    def _obey(self, command: Message) -> tuple[int, list[Message]]:
        """Obey a command. Returns the result (MAV_RESULT) and the messages to send after it."""
        number = int(command.param1) if math.isfinite(command.param1) else -1
        match command.command:
            case mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE if command.get_type() == "COMMAND_INT":
                # PX4 would take it as COMMAND_LONG too, with a latitude in float32.
                self.answers.append(self.brain.take_fix(command))
                return self.answers[-1], []
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                return self._set_interval(number, command.param2), []
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                return OK if number in self.reports else FAILED, self._make(number)
            case mavlink.MAV_CMD_SET_EKF_SOURCE_SET:
                return self.brain.use_source_set(command.param1), []
        return UNSUPPORTED, []

    def _set_interval(self, number: int, interval_us: float) -> int:
        """Set the interval of message `number` in microseconds (-1: never, 0: default). Returns a MAV_RESULT."""
        if number not in self.reports or not math.isfinite(interval_us):
            return DENIED
        interval_s = self._default_s.get(number, 0.0) if interval_us == 0 else interval_us / 1e6
        if interval_s <= 0:
            self._interval_s.pop(number, None)
        else:
            self._interval_s[number], self._due_s[number] = interval_s, self.brain.now_s
        return OK

    def _make(self, number: int) -> list[Message]:
        message = self.reports[number](self.brain) if number in self.reports else None
        return [message] if message else []
