"""The true position and attitude of the aircraft at any moment, from what the simulator tells 40 times a second."""

import math
import threading
from collections import deque
from dataclasses import dataclass

import numpy as np
from ground import GROUND_ALT_M

from edgevpr.lab.simulate.camera import CameraPose
from edgevpr.lab.simulate.generated import to_metres
from edgevpr.mavlink.wire import Message

_KEPT = 240  # states, six seconds: a fix is 5 s old at the most
_AHEAD_S = 0.3  # the farthest that a state is carried on


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """The true state: metres east, north and up, their rates (m/s), the attitude and its rates (radians)."""

    place_m: np.ndarray
    velocity_m_s: np.ndarray
    angles: np.ndarray  # roll, pitch, yaw
    rates: np.ndarray

    def after(self, seconds: float) -> CameraPose:
        """Return the pose so many seconds later, with steady rates."""
        east_m, north_m, up_m = self.place_m + self.velocity_m_s * seconds
        roll_deg, pitch_deg, yaw_deg = np.degrees(self.angles + self.rates * seconds)
        return CameraPose(
            east_m=float(east_m),
            north_m=float(north_m),
            height_m=float(up_m),
            heading_deg=float(yaw_deg % 360),
            roll_deg=float(roll_deg),
            pitch_deg=float(pitch_deg),
        )


class Truth:
    """Listens for SIM_STATE, and tells the pose `at` a time: the state before it, carried on."""

    def __init__(self) -> None:
        self._states: deque[tuple[float, State]] = deque(maxlen=_KEPT)
        self._lock = threading.Lock()

    def listen(self, message: Message, now_s: float) -> None:
        """Take note of a message."""
        if message.get_type() == "SIM_STATE":
            with self._lock:
                self._states.append((now_s, _state(message)))

    def at(self, t_mono_s: float) -> CameraPose | None:
        """Return the true pose at a time; None where nothing is known of it."""
        with self._lock:
            before = next((each for each in reversed(self._states) if each[0] <= t_mono_s), None)
        if before is None or t_mono_s - before[0] > _AHEAD_S:
            return None
        return before[1].after(t_mono_s - before[0])


def _state(message: Message) -> State:
    east_m, north_m = to_metres(message.lat_int / 1e7, message.lon_int / 1e7)
    roll, pitch = message.roll, message.pitch
    p, q, r = message.xgyro, message.ygyro, message.zgyro
    about_down = q * math.sin(roll) + r * math.cos(roll)  # what turns the nose sideways, seen by a level observer
    cos_pitch = max(math.cos(pitch), 0.1)
    rates = (
        p + about_down * math.sin(pitch) / cos_pitch,
        q * math.cos(roll) - r * math.sin(roll),
        about_down / cos_pitch,
    )
    return State(
        place_m=np.array((east_m, north_m, message.alt - GROUND_ALT_M)),
        velocity_m_s=np.array((message.ve, message.vn, -message.vd)),
        angles=np.array((roll, pitch, message.yaw)),
        rates=np.array(rates),
    )
