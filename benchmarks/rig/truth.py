"""The true position and attitude of the aircraft at any time, from the simulator's states at 40 Hz."""

import math
import threading
from collections import deque

import numpy as np
from ground import GROUND_ALT_M

from edgevpr.lab.simulate.camera import CameraPose
from edgevpr.lab.simulate.generated import to_metres
from edgevpr.mavlink.wire import Message, quaternion

_MAX_STATES = 240  # six seconds; a fix is at most 5 s old
_MAX_EXTRAPOLATION_S = 0.3
_RATE_INTERVAL_S = 0.03  # between the two states whose rates give the acceleration


class Truth:
    """Receives SIM_STATE (ArduPilot) or HIL_STATE_QUATERNION (PX4) and computes the pose at a time: the last state
    before it, extrapolated by its rates and their change (with constant rates, a picture rendered 0.1 s in advance was
    off by 10 degrees while a plane rolled). A state is two arrays (6,): east, north, up (metres), roll,
    pitch, yaw (radians); and their rates per second."""

    def __init__(self, ground_alt_m: float = GROUND_ALT_M) -> None:
        self._ground_alt_m = ground_alt_m
        self._states: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=_MAX_STATES)
        self._lock = threading.Lock()

    def handle_message(self, message: Message, now_s: float) -> None:
        """Store the state of a message, if it has one."""
        read_state = _READERS.get(message.get_type())
        if read_state:
            with self._lock:
                self._states.append((now_s, *read_state(message, self._ground_alt_m)))

    def compute_pose(self, t_mono_s: float) -> CameraPose | None:
        """Return the true pose at a time; None if there is no state shortly before it."""
        with self._lock:
            states = [state for state in self._states if t_mono_s - _MAX_EXTRAPOLATION_S <= state[0] <= t_mono_s]
        if not states:
            return None
        state_s, state, rates = states[-1]
        earlier_states = [earlier for earlier in states if earlier[0] <= state_s - _RATE_INTERVAL_S]
        earlier_s, _, earlier_rates = earlier_states[-1] if earlier_states else states[0]
        acceleration = (rates - earlier_rates) / max(state_s - earlier_s, _RATE_INTERVAL_S)
        dt_s = t_mono_s - state_s
        east_m, north_m, height_m, *angles = (state + rates * dt_s + acceleration * dt_s**2 / 2).tolist()
        roll_deg, pitch_deg, yaw_deg = map(math.degrees, angles)
        attitude = {"heading_deg": yaw_deg % 360, "roll_deg": roll_deg, "pitch_deg": pitch_deg}
        return CameraPose(east_m=east_m, north_m=north_m, height_m=height_m, **attitude)


def _read_sim_state(message: Message, ground_alt_m: float) -> tuple[np.ndarray, np.ndarray]:
    position_m = (*to_metres(message.lat_int / 1e7, message.lon_int / 1e7), message.alt - ground_alt_m)
    angles, body_rates = (message.roll, message.pitch, message.yaw), (message.xgyro, message.ygyro, message.zgyro)
    return _make_state(position_m, (message.ve, message.vn, -message.vd), angles, body_rates)


def _read_hil_state(message: Message, ground_alt_m: float) -> tuple[np.ndarray, np.ndarray]:
    position_m = (*to_metres(message.lat / 1e7, message.lon / 1e7), message.alt / 1e3 - ground_alt_m)
    velocity = (message.vy / 100, message.vx / 100, -message.vz / 100)
    angles = quaternion.QuaternionBase(message.attitude_quaternion).euler
    return _make_state(position_m, velocity, angles, (message.rollspeed, message.pitchspeed, message.yawspeed))


def _make_state(position_m, velocity_m_s, angles, body_rates) -> tuple[np.ndarray, np.ndarray]:
    roll, pitch, _ = angles
    p, q, r = body_rates
    level_yaw_rate = q * math.sin(roll) + r * math.cos(roll)  # about the z axis of the airframe without its roll
    cos_pitch = max(math.cos(pitch), 0.1)
    roll_rate = p + level_yaw_rate * math.sin(pitch) / cos_pitch
    pitch_rate, yaw_rate = q * math.cos(roll) - r * math.sin(roll), level_yaw_rate / cos_pitch
    return np.array((*position_m, *angles)), np.array((*velocity_m_s, roll_rate, pitch_rate, yaw_rate))


_READERS = {"SIM_STATE": _read_sim_state, "HIL_STATE_QUATERNION": _read_hil_state}
