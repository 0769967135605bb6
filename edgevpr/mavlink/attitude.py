"""Attitude and height of the vehicle, from what the autopilot says: at any moment of the last seconds."""

import math
from dataclasses import dataclass

from edgevpr.mavlink.wire import Message, mavlink

_KEPT_S = 3.0  # of attitudes: a frame is hardly ever older when it is recognised
_MOST_KEPT = 200
_NEAR_S = 0.3  # an attitude that is farther from a frame's time says nothing of the frame
_RANGE_FRESH_S = 1.0
_TERRAIN_FRESH_S = 2.5
_BAD_SIGNAL = 1  # of DISTANCE_SENSOR.signal_quality; 0 is unknown, 100 the best


@dataclass(frozen=True, slots=True)
class Attitude:
    """Roll (right wing down is positive), pitch (nose up) and yaw (clockwise from north), heard at `t_s`; degrees."""

    t_s: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float


class Attitudes:
    """The attitudes of the last seconds. One thread adds to them, and any may ask."""

    def __init__(self) -> None:
        self._kept: tuple[Attitude, ...] = ()

    @property
    def t_heard_s(self) -> float:
        """Time of the newest, -inf where there is none."""
        return self._kept[-1].t_s if self._kept else -math.inf

    def hear(self, message: Message, now_s: float) -> None:
        """Take in an ATTITUDE; one that is not finite is left out."""
        radians = message.roll, message.pitch, message.yaw
        if all(map(math.isfinite, radians)):
            kept = [each for each in self._kept[1 - _MOST_KEPT :] if now_s - each.t_s <= _KEPT_S]
            self._kept = (*kept, Attitude(now_s, *map(math.degrees, radians)))

    def at(self, t_s: float) -> Attitude | None:
        """Return the attitude at a time, from those heard before and after it; None where neither is within 0.3 s."""
        near = [each for each in self._kept if abs(each.t_s - t_s) <= _NEAR_S]
        before = next((each for each in reversed(near) if each.t_s <= t_s), None)
        after = next((each for each in near if each.t_s > t_s), None)
        if before is None or after is None:
            return before or after
        share = (t_s - before.t_s) / (after.t_s - before.t_s)

        def between(one_deg: float, other_deg: float) -> float:
            return one_deg + share * ((other_deg - one_deg + 180) % 360 - 180)

        return Attitude(
            t_s,
            between(before.roll_deg, after.roll_deg),
            between(before.pitch_deg, after.pitch_deg),
            between(before.yaw_deg, after.yaw_deg),
        )


class Heights:
    """The height above the ground, from the best of what the autopilot says: a range finder that looks down, then its
    model of the terrain, then the height over the take-off point."""

    def __init__(self) -> None:
        self._range: tuple[float, float] | None = None  # metres, time
        self._terrain: tuple[float, float] | None = None

    def hear(self, message: Message, now_s: float, attitude: Attitude | None) -> None:
        """Take in a DISTANCE_SENSOR or a TERRAIN_REPORT; `attitude` is that of now: a range finder looks along it."""
        if message.get_type() == "TERRAIN_REPORT":
            # A spacing of 0 says that the autopilot has no terrain of this place.
            self._terrain = (message.current_height, now_s) if message.spacing else None
        elif message.orientation == mavlink.MAV_SENSOR_ROTATION_PITCH_270:
            in_range = message.min_distance < message.current_distance < message.max_distance
            is_good = in_range and message.signal_quality != _BAD_SIGNAL
            lean = 1.0
            if attitude:
                lean = math.cos(math.radians(attitude.roll_deg)) * math.cos(math.radians(attitude.pitch_deg))
            self._range = (message.current_distance / 100 * max(0.0, lean), now_s) if is_good else None

    def now(self, over_takeoff_m: float, now_s: float) -> float:
        """Return the height, metres; `over_takeoff_m` is that over the take-off point."""
        for found, good_for_s in ((self._range, _RANGE_FRESH_S), (self._terrain, _TERRAIN_FRESH_S)):
            if found and now_s - found[1] <= good_for_s and math.isfinite(found[0]):
                return found[0]
        return over_takeoff_m
