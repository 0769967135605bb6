"""A simulated flight controller: what it hears, obeys and says. It knows no port and no clock; time is an argument."""

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass

from edgevpr.core.errors import UsageError
from edgevpr.lab.simulate.flightcontroller.ardupilot import ArduPilot
from edgevpr.lab.simulate.flightcontroller.px4 import Px4
from edgevpr.lab.simulate.flightcontroller.reports import Moment
from edgevpr.lab.simulate.flightcontroller.streams import Streams
from edgevpr.lab.simulate.flightcontroller.truth import Motion
from edgevpr.mavlink.messages import AUTOPILOT, POSITION_FIX
from edgevpr.mavlink.wire import Message, mavlink

STEP_S = 0.02
VEHICLES: dict[str, Callable[[Motion], ArduPilot | Px4]] = {
    "arducopter": lambda motion: ArduPilot("copter", motion),
    "arduplane": lambda motion: ArduPilot("plane", motion),
    "ardurover": lambda motion: ArduPilot("rover", motion),
    "px4-copter": lambda motion: Px4("copter", motion),
    "px4-plane": lambda motion: Px4("plane", motion),
}
_START_UTC_S = 1_770_000_000.0  # where nobody says when it starts
_FORCED = 21_196  # of an arming that passes over the checks
_NO_POSITION, _ONLY_VELOCITY = 0b000_111, 0b011_111  # of the type mask: a set bit is a value that is ignored


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedFix:
    """An accepted position fix as it arrived; `t_sent_s` and `processing_s` are the sender's."""

    lat_deg: float
    lon_deg: float
    accuracy_m: float
    t_sent_s: float
    processing_s: float


class FlightController:
    """One vehicle of a firmware, of those in VEHICLES. Without `gps` it has lost GPS in flight, before the start, which
    is at `start_utc_s` by its clock."""

    def __init__(
        self, vehicle: str, motion: Motion, *, gps: bool, system_id: int = 1, start_utc_s: float = _START_UTC_S
    ) -> None:
        if vehicle not in VEHICLES:
            raise UsageError(f"There is no vehicle {vehicle!r}: choose one of {', '.join(VEHICLES)}.")
        self.brain = VEHICLES[vehicle](motion)
        self.vehicle, self.system_id = vehicle, system_id
        self._start_utc_s = start_utc_s
        self.fixes: list[ReceivedFix] = []
        self.answers: list[int] = []  # to fixes, MAV_RESULT
        self._motion = motion
        self._streams = Streams(self.brain.default_hz, self.brain.filter_report, motion.is_known)
        self._now_s, self._truth = 0.0, motion.step(0.0, 0.0)
        self._has_begun = False
        if not gps:
            self.brain.lose_gps(self._truth, 0.0)

    def __str__(self) -> str:
        gps = "with GPS" if self.brain.parameters["SIM_GPS1_ENABLE"] else "that has lost GPS"
        return f"a simulated {self.vehicle} {gps}, system {self.system_id},"

    @property
    def error_m(self) -> float:
        """Distance of the estimate from the truth."""
        return abs(self.brain.reckoning.error_m)

    def set(self, name: str, value: float) -> None:
        """Set a parameter, as PARAM_SET does: SIM_GPS1_ENABLE 0 takes GPS away."""
        self.brain.parameters.set(name, value)

    def begin(self) -> None:
        """Note that a flight is heard; a track starts when it first is."""
        if not self._has_begun:
            self._has_begun = True
            self._motion.begin(self._now_s)

    def advance(self, now_s: float) -> list[Message]:
        """Go on to `now_s`, in small steps; return what is said on the way."""
        said = []
        while self._now_s + STEP_S <= now_s:
            self._now_s += STEP_S
            self._truth = self._motion.step(self._now_s, STEP_S)
            self.brain.step(self._truth, self._wind_m_s(), self._now_s, STEP_S)
            said += self._streams.due(self._moment())
            said += [mavlink.MAVLink_statustext_message(each[0], each[1].encode()) for each in self.brain.texts]
            self.brain.texts.clear()
        return said

    def hear(self, message: Message) -> list[Message]:
        """Take in a message; return the answers."""
        kind = message.get_type()
        if getattr(message, "target_system", 0) not in (0, self.system_id):
            return []
        if getattr(message, "target_component", 0) not in (0, AUTOPILOT):
            return []
        if kind in ("COMMAND_INT", "COMMAND_LONG"):
            return self._obey(message)
        if kind in ("PARAM_REQUEST_READ", "PARAM_REQUEST_LIST", "PARAM_SET"):
            return self.brain.parameters.answer(message)
        if kind == "TIMESYNC" and message.tc1 == 0:
            return [mavlink.MAVLink_timesync_message(round(self._now_s * 1e9) + 1, message.ts1)]
        if kind == "PING" and message.target_system == 0 and self.brain.firmware == mavlink.MAV_AUTOPILOT_PX4:
            to = message.get_srcSystem(), message.get_srcComponent()
            return [mavlink.MAVLink_ping_message(message.time_usec, message.seq, *to)]
        if kind == "SET_MODE":
            self.brain.set_mode(message.custom_mode)
        elif kind == "GPS_INPUT":
            self.brain.receivers.hear(message, self._now_s)
        elif kind in ("ODOMETRY", "VISION_POSITION_ESTIMATE"):
            self.brain.external.hear(message, self._now_s)
        elif kind == "GLOBAL_POSITION_SENSOR":
            self.brain.take_global_position(message, self._truth, self._now_s)
        elif kind == "SET_POSITION_TARGET_LOCAL_NED" and self.brain.is_armed:
            if message.type_mask & _ONLY_VELOCITY == _NO_POSITION:
                self._motion.fly(complex(message.vy, message.vx), self._now_s)
        elif kind == "SET_GPS_GLOBAL_ORIGIN":
            return self._set_origin(message)
        return []

    def _obey(self, command: Message) -> list[Message]:
        if command.command == POSITION_FIX:
            return [self._ack(command, self._judge(command))]
        known = _COMMANDS.get(command.command)
        if known is None:
            return [self._ack(command, mavlink.MAV_RESULT_UNSUPPORTED)]
        result, answers = known(self, command)
        return [self._ack(command, result), *answers]

    def _judge(self, command: Message) -> int:
        if command.get_type() == "COMMAND_LONG":  # PX4 would take that too, with a latitude in float32
            return mavlink.MAV_RESULT_UNSUPPORTED
        result = self.brain.take_fix(command, self._truth, self._now_s)
        self.answers.append(result)
        if result == mavlink.MAV_RESULT_ACCEPTED:
            self.fixes.append(
                ReceivedFix(
                    lat_deg=command.x / 1e7,
                    lon_deg=command.y / 1e7,
                    accuracy_m=command.param3,
                    t_sent_s=command.param1,
                    processing_s=command.param2,
                )
            )
        return result

    def _set_interval(self, command: Message) -> tuple[int, list[Message]]:
        number = int(command.param1)
        if self._streams.ask(number, command.param2, self._now_s):
            return mavlink.MAV_RESULT_ACCEPTED, []
        if self.brain.firmware == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
            self.brain.texts.append((mavlink.MAV_SEVERITY_INFO, f"No ap_message for mavlink id ({number})"))
        return mavlink.MAV_RESULT_DENIED, []

    def _get_interval(self, command: Message) -> tuple[int, list[Message]]:
        number = int(command.param1)
        answer = mavlink.MAVLink_message_interval_message(number, self._streams.interval_us(number))
        return mavlink.MAV_RESULT_ACCEPTED, [answer]

    def _send_once(self, command: Message) -> tuple[int, list[Message]]:
        number = int(command.param1)
        if not self._streams.knows(number):
            return mavlink.MAV_RESULT_FAILED, []
        message = self._streams.make(number, self._moment())
        return mavlink.MAV_RESULT_ACCEPTED, [message] if message else []

    def _arm(self, command: Message) -> tuple[int, list[Message]]:
        is_wanted = command.param1 == 1
        why_not = self.brain.why_not_arm(self._now_s) if is_wanted and command.param2 != _FORCED else None
        if why_not:
            text = f"Arm: {why_not}" if self.brain.firmware == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA else why_not
            told = mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_CRITICAL, text.encode())
            return mavlink.MAV_RESULT_FAILED, [told]
        self.brain.arm(is_wanted)
        return mavlink.MAV_RESULT_ACCEPTED, []

    def _take_off(self, command: Message) -> tuple[int, list[Message]]:
        height_m = command.param7 if command.get_type() == "COMMAND_LONG" else command.z
        return self.brain.take_off(height_m, self._truth), []

    def _set_mode(self, command: Message) -> tuple[int, list[Message]]:
        mode = int(command.param2)
        if self.brain.firmware == mavlink.MAV_AUTOPILOT_PX4:
            mode = mode << 16 | int(command.param3) << 24
        is_taken = self.brain.set_mode(mode)
        return (mavlink.MAV_RESULT_ACCEPTED if is_taken else mavlink.MAV_RESULT_FAILED), []

    def _use_source_set(self, command: Message) -> tuple[int, list[Message]]:
        return self.brain.use_source_set(command.param1), []

    def _set_origin(self, message: Message) -> list[Message]:
        lat_deg, lon_deg = message.latitude / 1e7, message.longitude / 1e7
        if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180) or lat_deg == lon_deg == 0:
            return []
        if not self.brain.set_origin(lat_deg, lon_deg, message.altitude / 1e3, self._truth):
            return []
        told = self._streams.make(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, self._moment())
        return [told] if told else []

    def _ack(self, command: Message, result: int) -> Message:
        return mavlink.MAVLink_command_ack_message(
            command=command.command,
            result=result,
            target_system=command.get_srcSystem(),
            target_component=command.get_srcComponent(),
        )

    def _moment(self) -> Moment:
        return Moment(
            t_s=self._now_s,
            start_utc_s=self._start_utc_s,
            truth=self._truth,
            brain=self.brain,
            is_known=self._motion.is_known,
        )

    def _wind_m_s(self) -> complex:
        parameters = self.brain.parameters
        from_deg = parameters["SIM_WIND_DIR"]
        return -cmath.rect(parameters["SIM_WIND_SPD"], math.radians(90 - from_deg))


_COMMANDS = {
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: FlightController._set_interval,
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: FlightController._get_interval,
    mavlink.MAV_CMD_REQUEST_MESSAGE: FlightController._send_once,
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: FlightController._arm,
    mavlink.MAV_CMD_NAV_TAKEOFF: FlightController._take_off,
    mavlink.MAV_CMD_DO_SET_MODE: FlightController._set_mode,
    mavlink.MAV_CMD_SET_EKF_SOURCE_SET: FlightController._use_source_set,
}
