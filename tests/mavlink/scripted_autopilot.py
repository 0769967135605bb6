"""An autopilot that is worked by hand, in a conversation without a port."""

import math
import struct
from dataclasses import replace

from fakes import FakeClock

from edgevpr.mavlink.conversation import Conversation, LinkSettings
from edgevpr.mavlink.messages import Fix, MotionState
from edgevpr.mavlink.peer import Listener
from edgevpr.mavlink.wire import PacketReader, mavlink

ABS = mavlink.EKF_POS_HORIZ_ABS
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
FIX_3D = mavlink.GPS_FIX_TYPE_3D_FIX


STATE = MotionState(
    t_mono_s=0.0,
    lat_deg=47.0,
    lon_deg=8.0,
    alt_m=500.0,
    velocity_m_s=(1.0, 2.0, 0.0),
    accuracy_m=3.0,
    alt_accuracy_m=3.0,
    speed_accuracy_m_s=0.5,
    attitude=(0.0, 0.0, 0.5),
)


class RecordingListener(Listener):
    """Counts autopilots, notes channels and forces, and gives a `state` and a fix `between` matches."""

    def __init__(self):
        self.autopilots, self.channels, self.forces, self.state, self.between = 0, [], [], STATE, None

    def handle_autopilot(self, t_s):
        self.autopilots += 1

    def handle_channel(self, channel):
        self.channels.append(channel)

    def handle_specific_force(self, t_s, force_m_s2, attitude):
        self.forces.append((force_m_s2, attitude.roll_deg))

    def estimate_state(self, t_s):
        return self.state and replace(self.state, t_mono_s=t_s)

    def make_interim_fix(self, now_s):
        return self.between and replace(self.between, t_frame_s=now_s)


class Autopilot:
    """Autopilot 7, at 50, 8 unless it says another place; it says what it is told to. It booted at `booted_s` of our
    clock, and answers TIMESYNC, which is in no list, after `timesync_s` seconds (None: never)."""

    def __init__(self, firmware=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, booted_s=0.0, timesync_s=0.0, **settings) -> None:
        self.clock, self.firmware = FakeClock(), firmware
        self.conversation = Conversation(LinkSettings(**settings), self.clock)
        self._packers, self.packets = {}, []
        self.booted_s, self.timesync_s = booted_s, timesync_s
        self.beat()
        self._listen()

    @property
    def boot_s(self):
        return self.clock.now_s - self.booted_s

    @property
    def boot_ms(self):
        return round(self.boot_s * 1e3) % 2**32

    def reboot(self, silent_s=1.6):
        """Start anew, and be silent meanwhile."""
        self.wait(silent_s)
        self.booted_s = self.clock.now_s - 1.0

    def _listen(self, address=None):
        """Take what is sent now, and answer the questions for the time."""
        for packet, fix in iter(self.conversation.next_packet, None):
            (message,) = PacketReader().feed(packet)
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                if self.timesync_s is not None:
                    self.wait(self.timesync_s)
                    answer = mavlink.MAVLink_timesync_message(round(self.boot_s * 1e9) + 1, message.ts1)
                    self.send(answer, address=address)
            else:
                self.packets.append(packet)
            if fix:
                fix.settle(True)
                self.conversation.count_sent_fixes([fix])

    def send(self, message, system_id=7, component_id=1, address=None):
        packer = self._packers.setdefault((system_id, component_id), mavlink.MAVLink(None, system_id, component_id))
        self.conversation.handle(message.pack(packer), self.clock.now_s, address)

    def beat(self, base_mode=ARMED, **sender):
        self.send(mavlink.MAVLink_heartbeat_message(2, self.firmware, base_mode, 0, 4, 3), **sender)

    def position(self, lat_deg=50.0, lon_deg=8.0, hdg=9050, vx=0, vy=0, **sender):
        self.locate((lat_deg, lon_deg), 312.5, 80.0, (vx, vy, 0), hdg, **sender)
        return self.vehicle

    def locate(self, at_deg, alt_m, relative_m, velocity_cm_s=(0, 0, 0), hdg=9050, **sender):
        where = *(round(degrees * 1e7) for degrees in at_deg), round(alt_m * 1e3), round(relative_m * 1e3)
        self.send(mavlink.MAVLink_global_position_int_message(self.boot_ms, *where, *velocity_cm_s, hdg), **sender)

    def gps(self, fix_type=FIX_3D, h_acc=0, message=mavlink.MAVLink_gps_raw_int_message, lat_deg=50.0):
        second = () if message is mavlink.MAVLink_gps_raw_int_message else (0, 0)
        self.send(message(0, fix_type, round(lat_deg * 1e7), 80_000_000, 0, 80, 120, 0, 0, 14, *second, h_acc=h_acc))

    def attitude(self, roll_deg=0.0, pitch_deg=0.0, yaw_deg=0.0, pitch_deg_s=0.0, yaw_deg_s=0.0):
        radians = map(math.radians, (roll_deg, pitch_deg, yaw_deg, 0.0, pitch_deg_s, yaw_deg_s))
        self.send(mavlink.MAVLink_attitude_message(self.boot_ms, *radians))

    def fly_on(self, seconds, attitude_hz, filter_flags=831):
        for _ in range(seconds * attitude_hz):
            self.wait(1 / attitude_hz)
            self.beat()
            self.position()
            self.attitude()
            if filter_flags is not None:
                self.filter(filter_flags)

    def range(self, distance_m, orientation=25, signal_quality=0):
        fields = 0, 20, 10_000, round(distance_m * 100), 0, 0, orientation, 0
        self.send(mavlink.MAVLink_distance_sensor_message(*fields, signal_quality=signal_quality))

    def terrain(self, height_m, spacing=100):
        self.send(mavlink.MAVLink_terrain_report_message(500_000_000, 80_000_000, spacing, 0.0, height_m, 0, 9))

    def filter(self, flags):
        self.send(mavlink.MAVLink_ekf_status_report_message(flags, 0.1, 0.1, 0.1, 0.1, 0.1))

    def px4_filter(self, accuracy_m, flags=ABS):
        self.send(mavlink.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, accuracy_m, 1.0))

    def put_fix(self, accuracy_m=12.0, **sender):
        """Let a fix be sent where one may be; it leaves at once."""
        self.beat(**sender)
        sending = self.conversation.fixes.put(Fix(50.0, 8.0, accuracy_m, self.clock.now_s), self.clock.now_s)
        self._listen(sender.get("address"))
        return sending

    def answer(self, result, command=43003, to=197):
        self.send(mavlink.MAVLink_command_ack_message(command, result, target_system=7, target_component=to))

    def take_fix(self, result, accuracy_m=12.0):
        """Let a fix be sent, and answer it."""
        self.put_fix(accuracy_m)
        self.answer(result)

    def wait(self, seconds):
        self.clock.now_s += seconds

    def take_sent(self):
        """The messages that have been sent since the last call."""
        self.conversation.announce_changes()
        self._listen()
        packets, self.packets = self.packets, []
        return list(PacketReader().feed(b"".join(packets)))

    def reply(self, parameters, is_lost=lambda message: False, errors=False):
        """Answer the questions among them, and return all. About a parameter that it does not have it is silent, or
        says so (`errors`); a question or answer that `is_lost` does not arrive."""
        told = self.take_sent()
        for message in told:
            if message.get_type() == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
                nothing = [bytes(8)] * 3
                self.send(mavlink.MAVLink_autopilot_version_message(0, 1 << 24 | 17 << 16, 0, 0, 0, *nothing, 0, 0, 0))
            if message.get_type() != "PARAM_REQUEST_READ" or is_lost(message):
                continue
            if message.param_id in parameters:
                answer = self.parameter(message.param_id, parameters[message.param_id])
            elif errors:
                answer = mavlink.MAVLink_param_error_message(255, 0, message.param_id.encode(), -1, 1)
            else:
                continue
            if not is_lost(answer):
                self.send(answer)
        return told

    def parameter(self, name, value):
        """Its message for a parameter: PX4 sends the bytes of a whole number."""
        kind = mavlink.MAV_PARAM_TYPE_INT32 if isinstance(value, int) else mavlink.MAV_PARAM_TYPE_REAL32
        if isinstance(value, int) and self.firmware == mavlink.MAV_AUTOPILOT_PX4:
            value = struct.unpack("<f", struct.pack("<i", value))[0]
        return mavlink.MAVLink_param_value_message(name.encode(), value, kind, 1000, 65535)

    def questions(self):
        """The commands among them."""
        return [message for message in self.take_sent() if message.get_type() == "COMMAND_LONG"]

    def texts(self):
        """The severities and texts among them."""
        return [(message.severity, message.text) for message in self.take_sent() if message.get_type() == "STATUSTEXT"]

    @property
    def vehicle(self):
        return self.conversation.autopilot.vehicle

    def predict(self, t_s):
        return self.conversation.predict_vehicle(t_s)

    def sd_m(self):
        """The certainty that comes with its next report."""
        return self.position().position_sd_m
