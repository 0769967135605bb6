"""A closed loop without sockets, threads and real time: a simulated autopilot whose vehicle obeys its estimate, and the
conversation and the navigator of edgevpr beside it, in steps of 40 ms. The same flight without edgevpr is its control.
"""

import cmath
import math
from dataclasses import replace

import numpy as np
from fakes import FakeClock
from simulated.controller import STEP_S, FlightController
from simulated.motion import Hover, displacement_m
from simulated_flight import PICTURE, make_match

from edgevpr.core.geodesy import offset_position
from edgevpr.core.types import Frame, Position
from edgevpr.frames.level import LevelledImage, View
from edgevpr.lab.simulate.generated import ORIGIN
from edgevpr.mavlink.conversation import Conversation, LinkSettings
from edgevpr.mavlink.messages import Health
from edgevpr.mavlink.wire import PacketReader, mavlink
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.recognise.odometry import OdometryStep
from edgevpr.runtime.recognise.parallax import claim_unseen_change
from edgevpr.runtime.recognise.perspective import AttitudeError
from edgevpr.runtime.recognise.recognition import Recognition

HEIGHT_M = 60.0
_FRAME_S = 1.0  # from frame to frame
_MATCH_SD_M = 1.0
_STRIDE_SD_M = 0.2
_SHOWN_SD = math.tan(math.radians(1.0))
_VIEW = View(up_deg=0.0, footprint_m=60.0, nadir_offset=(0.0, 0.0))


class ClosedLoop:
    """A flight of a `vehicle` of the flight controller with its `parameters`, that hovers or cruises by a velocity.

    While it `matches`, each `match_every`-th frame is recognised `late_s` later, `map_off_m` (east + 1j * north) beside
    the truth. While it `sees_motion`, each frame has a stride. `stride_scale` is by what strides are too long (its
    changes are seen where landmarks `show_ground`), `time_error_s` by how much frames carry too late a time, and
    `mount_tilt_deg` by how much the camera looks east of straight down. Its messages arrive `downlink_s` late.
    `heading_error_deg`: of the autopilot. Gyros have the noise `gyro_sd` (radians, a root second); matches show the
    error of the attitude where they `show_tilt`. `away_m` and `error_m` are, step by step, the true distance from the
    target, and that of the estimate from the truth; `sent` is all that is sent, with the times."""

    def __init__(self, vehicle, *, edgevpr=True, matches=True, velocity_m_s=0j, min_accuracy_m=1.0, **parameters):
        self.motion = Hover(Position(ORIGIN.lat_deg, ORIGIN.lon_deg, ORIGIN.alt_m), HEIGHT_M, velocity_m_s)
        self.controller = FlightController(vehicle, self.motion, gps=True)
        for name, value in parameters.items():
            self.controller.set(name, value)
        self.sees_motion = True
        self.matches, self.match_every, self.map_off_m, self.stride_scale = matches, 1, 0j, 1.0
        self.show_ground, self._last_stride_scale, self._missed_m = False, 1.0, 0.0
        self.late_s, self.time_error_s, self.mount_tilt_deg = 0.5, 0.0, 0.0
        self.heading_error_deg, self.gyro_sd, self.show_tilt = 0.0, 0.0, False
        self.away_m, self.error_m, self.sent, self._underway, self.downlink_s = [], [], [], [], 0.0
        self._clock, self._rng, self._steps = FakeClock(), np.random.default_rng(5), 0
        self._packer, self._reader = mavlink.MAVLink(None, 1, 1), PacketReader()
        self._min_accuracy_m, self.conversation = min_accuracy_m, None
        if edgevpr:
            self.start()

    def start(self):
        """Start edgevpr, or start it again in flight."""
        self.navigator = Navigator(self._min_accuracy_m, _FRAME_S)
        self.conversation = Conversation(LinkSettings(clock=self._clock, listener=self.navigator), self._clock)
        self.conversation.request_position()
        self.conversation.requests.is_flying = True
        self._waiting, self._last_frame = [], None
        return self

    @property
    def now_s(self) -> float:
        return self._steps * STEP_S

    @property
    def brain(self):
        return self.controller.brain

    def set(self, name, value):
        self.controller.set(name, value)
        return self

    def fly(self, seconds):
        for _ in range(round(seconds / STEP_S)):
            self._steps += 1
            self._clock.now_s = 1000.0 + self.now_s
            if self.gyro_sd:
                self.brain.estimator.disturb(self._noise(self.gyro_sd * math.sqrt(STEP_S)))
            self.brain.heading_error_deg = self.heading_error_deg
            said = self.controller.advance(self.now_s + STEP_S / 2)
            self.away_m.append(self.motion.away_m)
            self.error_m.append(self.controller.error_m)
            if self.conversation:
                self._exchange(said)
                if self._steps % round(_FRAME_S / STEP_S) == 0:
                    self._take_frame()
                if self._waiting and self._waiting[0].frame.t_mono_s <= self._clock.now_s - self.late_s:
                    self._recognise(self._waiting.pop(0))
        return self

    def worst_m(self, since_s):
        """Return the largest distance from the target, and of the estimate from the truth, since a time."""
        first = round(since_s / STEP_S)
        return max(self.away_m[first:]), max(self.error_m[first:])

    def command(self, number, *values):
        """Send a command to the autopilot."""
        padded = [*values, *[0] * (7 - len(values))]
        self._exchange(self.controller.receive(mavlink.MAVLink_command_long_message(1, 1, number, 0, *padded)))

    def ask(self, number, *values):
        """Let the ground station send a command to edgevpr; return the result."""
        padded = [*values, *[0] * (7 - len(values))]
        command = mavlink.MAVLink_command_long_message(1, 197, number, 0, *padded)
        self.conversation.handle(command.pack(mavlink.MAVLink(None, 255, 190)), self._clock.now_s, None)
        first = len(self.sent)
        self._exchange([])
        return next(each.result for _, each in self.sent[first:] if each.get_type() == "COMMAND_ACK")

    def positions_sent(self, since_s):
        """Return the times of all positions sent since a time, of every channel."""
        return [t_s for t_s, message in self.sent if t_s > since_s and _is_position(message)]

    def _exchange(self, said):
        """Let edgevpr hear messages, and the autopilot what it sends, until neither has more to say."""
        conversation, now_s = self.conversation, self._clock.now_s
        if not conversation:
            return
        if self.downlink_s:
            self._underway += [(now_s + self.downlink_s, message) for message in said]
            said = [message for due_s, message in self._underway if due_s <= now_s]
            self._underway = [waiting for waiting in self._underway if waiting[0] > now_s]
        while True:
            if said:
                conversation.handle(b"".join(map(self._pack, said)), now_s, None)
            said, sending = [], []
            while packet := conversation.next_packet():
                sending += [packet[1]] if packet[1] else []
                for message in self._reader.feed(packet[0]):
                    self.sent.append((self.now_s, message))
                    said += self.controller.receive(message)
            conversation.count_sent_fixes(sending)
            if not said:
                break
        if self._steps % round(1 / STEP_S) == 0:
            conversation.set_health(Health.ACTIVE)
            conversation.announce_changes()

    def _pack(self, message):
        packet = message.pack(self._packer)
        self._packer.seq = (self._packer.seq + 1) % 256
        return packet

    def _take_frame(self):
        truth, t_s = self.brain.truth, self._clock.now_s + self.time_error_s
        vehicle = self.conversation.predict_vehicle(t_s)
        frames = round(self.now_s / _FRAME_S)
        if self.matches and frames % self.match_every == 0:
            # A camera that is levelled by an attitude that is wrong puts the place beside the true one.
            off_m = self.map_off_m + HEIGHT_M * math.tan(math.radians(self.mount_tilt_deg))
            off_m += HEIGHT_M * self.brain.tilt + self._noise(_MATCH_SD_M)
            place = Position(*offset_position(truth.lat_deg, truth.lon_deg, off_m.real, off_m.imag))
            shown = self.show_tilt and self._noise(_SHOWN_SD) - self.brain.tilt
            error = AttitudeError((shown.real, shown.imag), _SHOWN_SD) if self.show_tilt else None
            event = make_match(place, t_s, vehicle, _MATCH_SD_M, (self._steps,), _VIEW, error)
            event = replace(event, located=replace(event.located, heading_deg=-self.heading_error_deg))
        else:
            frame = Frame(image=PICTURE, name="", t_mono_s=t_s)
            event = Recognition(frame=frame, vehicle=vehicle, picture=LevelledImage(PICTURE, None, _VIEW))
        self._waiting.append(replace(event, odometry=self._measure_odometry(truth, t_s)))

    def _measure_odometry(self, truth, t_s):
        before, self._last_frame = self._last_frame, (truth, t_s, self.brain.tilt)
        if before is None:
            return None
        if not self.sees_motion:
            self._missed_m += abs(displacement_m(before[0].point, truth.point))
            return None
        was, from_s, tilt = before
        missed_m, self._missed_m = self._missed_m, 0.0
        last_scale, self._last_stride_scale = self._last_stride_scale, self.stride_scale
        log_height = math.log(last_scale / self.stride_scale) if self.show_ground else 0.0
        scale = cmath.rect(self.stride_scale, -math.radians(self.heading_error_deg))
        moved_m = scale * displacement_m(was.point, truth.point)
        moved_m += HEIGHT_M * (self.brain.tilt - tilt) + self._noise(_STRIDE_SD_M)
        return OdometryStep(
            from_s=from_s,
            to_s=t_s,
            moved_m=(moved_m.real, moved_m.imag),
            sd_m=_STRIDE_SD_M,
            inliers=100,
            log_height=log_height,
            log_height_sd=math.hypot(0.25 * log_height, claim_unseen_change(missed_m / _VIEW.footprint_m).sd),
        )

    def _noise(self, sd):
        return complex(*self._rng.normal(0, sd, 2))

    def _recognise(self, event):
        if not event.accepted:
            self.navigator.handle_frame(event)
            return
        fix = self.navigator.advise(event, self._clock.now_s).fix
        if fix:
            self.conversation.send_fix(fix)


def _is_position(message):
    match message.get_type():
        case "GPS_INPUT":
            return message.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX
        case "ODOMETRY" | "GLOBAL_POSITION_SENSOR":
            return True
        case "COMMAND_INT":
            return message.command == mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
    return False
