"""The true position and attitude of the aircraft at any time, from the simulator's states, 40 a second."""

import math
import threading
from collections import deque

import numpy as np
from ground import GROUND_ALT_M

from edgevpr.lab.simulate.camera import CameraPose
from edgevpr.lab.simulate.generated import to_metres
from edgevpr.mavlink.wire import Message, quaternion

_MAX_STATES = 240  # states, six seconds: a fix is 5 s old at the most
_MAX_EXTRAPOLATION_S = 0.3  # the farthest that a state is carried on
_RATE_INTERVAL_S = 0.03  # between two states whose rates are compared


class Truth:
    """Receives SIM_STATE (ArduPilot) or HIL_STATE_QUATERNION (PX4), and computes the pose at a time: the state before
    it, extrapolated with its rates and their change: at constant rates, a picture rendered 0.1 s ahead was 10 degrees
    off as a plane rolled. A state is metres east, north and up, and roll, pitch and yaw (radians); then the rates of
    these six a second."""

    def __init__(self, ground_alt_m: float = GROUND_ALT_M) -> None:
        self._ground_alt_m = ground_alt_m
        self._states: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=_MAX_STATES)
        self._lock = threading.Lock()

    def handle_message(self, message: Message, now_s: float) -> None:
        """Take note of a message."""
        state = _READERS.get(message.get_type())
        if state:
            with self._lock:
                self._states.append((now_s, *state(message, self._ground_alt_m)))

    def compute_pose(self, t_mono_s: float) -> CameraPose | None:
        """Return the true pose at a time; None where nothing is known of it."""
        with self._lock:
            states = [state for state in self._states if t_mono_s - _MAX_EXTRAPOLATION_S <= state[0] <= t_mono_s]
        if not states:
            return None
        then_s, state, rates = states[-1]
        before = [earlier for earlier in states if earlier[0] <= then_s - _RATE_INTERVAL_S]
        earlier_s, _, earlier = before[-1] if before else states[0]
        change = (rates - earlier) / max(then_s - earlier_s, _RATE_INTERVAL_S)
        on_s = t_mono_s - then_s
        east_m, north_m, height_m, *angles = (state + rates * on_s + change * on_s**2 / 2).tolist()
        roll_deg, pitch_deg, yaw_deg = map(math.degrees, angles)
        attitude = {"heading_deg": yaw_deg % 360, "roll_deg": roll_deg, "pitch_deg": pitch_deg}
        return CameraPose(east_m=east_m, north_m=north_m, height_m=height_m, **attitude)


def _read_sim_state(message: Message, ground_alt_m: float) -> tuple[np.ndarray, np.ndarray]:
    place = (*to_metres(message.lat_int / 1e7, message.lon_int / 1e7), message.alt - ground_alt_m)
    angles, turns = (message.roll, message.pitch, message.yaw), (message.xgyro, message.ygyro, message.zgyro)
    return _make_state(place, (message.ve, message.vn, -message.vd), angles, turns)


def _read_hil_state(message: Message, ground_alt_m: float) -> tuple[np.ndarray, np.ndarray]:
    place = (*to_metres(message.lat / 1e7, message.lon / 1e7), message.alt / 1e3 - ground_alt_m)
    velocity = (message.vy / 100, message.vx / 100, -message.vz / 100)
    angles = quaternion.QuaternionBase(message.attitude_quaternion).euler
    return _make_state(place, velocity, angles, (message.rollspeed, message.pitchspeed, message.yawspeed))


def _make_state(place_m, velocity_m_s, angles, turns) -> tuple[np.ndarray, np.ndarray]:
    roll, pitch, _ = angles
    p, q, r = turns
    about_down = q * math.sin(roll) + r * math.cos(roll)  # what turns the nose sideways, seen by a level observer
    cos_pitch = max(math.cos(pitch), 0.1)
    roll_rate = p + about_down * math.sin(pitch) / cos_pitch
    pitch_rate, yaw_rate = q * math.cos(roll) - r * math.sin(roll), about_down / cos_pitch
    return np.array((*place_m, *angles)), np.array((*velocity_m_s, roll_rate, pitch_rate, yaw_rate))


_READERS = {"SIM_STATE": _read_sim_state, "HIL_STATE_QUATERNION": _read_hil_state}
