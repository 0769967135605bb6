"""The true position and attitude of the aircraft at any moment, from what the simulator tells 40 times a second."""

import math
import threading
from collections import deque

import numpy as np
from ground import GROUND_ALT_M

from edgevpr.lab.simulate.camera import CameraPose
from edgevpr.lab.simulate.generated import to_metres
from edgevpr.mavlink.wire import Message

_KEPT = 240  # states, six seconds: a fix is 5 s old at the most
_AHEAD_S = 0.3  # the farthest that a state is carried on


class Truth:
    """Listens for SIM_STATE, and tells the pose `at` a time: the state before it, carried on at steady rates. Kept of a
    state are metres east, north and up, and roll, pitch and yaw (radians); then the rates of these six a second."""

    def __init__(self) -> None:
        self._states: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=_KEPT)
        self._lock = threading.Lock()

    def listen(self, message: Message, now_s: float) -> None:
        """Take note of a message."""
        if message.get_type() == "SIM_STATE":
            with self._lock:
                self._states.append((now_s, *_state(message)))

    def at(self, t_mono_s: float) -> CameraPose | None:
        """Return the true pose at a time; None where nothing is known of it."""
        with self._lock:
            before = next((each for each in reversed(self._states) if each[0] <= t_mono_s), None)
        if before is None or t_mono_s - before[0] > _AHEAD_S:
            return None
        then_s, state, rates = before
        east_m, north_m, height_m, *angles = (state + rates * (t_mono_s - then_s)).tolist()
        roll_deg, pitch_deg, yaw_deg = map(math.degrees, angles)
        attitude = {"heading_deg": yaw_deg % 360, "roll_deg": roll_deg, "pitch_deg": pitch_deg}
        return CameraPose(east_m=east_m, north_m=north_m, height_m=height_m, **attitude)


def _state(message: Message) -> tuple[np.ndarray, np.ndarray]:
    east_m, north_m = to_metres(message.lat_int / 1e7, message.lon_int / 1e7)
    roll, pitch = message.roll, message.pitch
    p, q, r = message.xgyro, message.ygyro, message.zgyro
    about_down = q * math.sin(roll) + r * math.cos(roll)  # what turns the nose sideways, seen by a level observer
    cos_pitch = max(math.cos(pitch), 0.1)
    roll_rate = p + about_down * math.sin(pitch) / cos_pitch
    pitch_rate, yaw_rate = q * math.cos(roll) - r * math.sin(roll), about_down / cos_pitch
    state = (east_m, north_m, message.alt - GROUND_ALT_M, roll, pitch, message.yaw)
    return np.array(state), np.array((message.ve, message.vn, -message.vd, roll_rate, pitch_rate, yaw_rate))
