"""Observers of the events of a flight that say how its pictures differ from what map and configuration say of them."""

import cmath
import math
from collections import deque

import numpy as np

from edgevpr.core.config import SourceConfig
from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight.herald import Herald
from edgevpr.runtime.recognise.recognition import Recognition

# Accepted matches, and a picture's footprint over that of the map, between which nothing is said: as much is found, by
# benchmarks/results/from_space.md.
_SCALED_BY, _SCALES = 10, (0.87, 1.4)
# Accepted matches in a row by which pictures are turned, and the least turn; with this length of the mean of their
# directions they agree to some ten degrees. A compass is rarely wrong by so much, a camera is by 90 or 180.
_TURNED_BY, _TURNED_DEG, _AGREE = 10, 20.0, 0.97


class ScaleWatch:
    """Says once if pictures show clearly more or less ground than those that were cut from an orthophoto for the map: a
    map cut to the right size finds more. It goes by the first matches that are accepted."""

    def __init__(self, herald: Herald) -> None:
        self._herald = herald
        self._seen: list[tuple[float, float]] = []  # ground along a picture in flight, and in the map, metres

    def tell(self, event: Recognition) -> None:
        """Take the ground that the match of an event shows."""
        pose, where = event.best and event.best.place.pose, event.located
        if len(self._seen) == _SCALED_BY or not (where and where.height_ratio and pose and pose.is_surveyed):
            return
        self._seen.append((pose.footprint_m * where.height_ratio, pose.footprint_m))
        if len(self._seen) < _SCALED_BY:
            return
        flown_m, cut_m = np.median(self._seen, axis=0).tolist()
        if not _SCALES[0] <= flown_m / cut_m <= _SCALES[1]:
            text = f"a picture shows {flown_m:.0f} m of ground, the map was cut for {cut_m:.0f} m"
            ground = f"footprint {flown_m:.0f} m, map's {cut_m:.0f} m"
            said = f"{text}: --footprint-m {flown_m:.0f} finds more"
            self._herald.tell("camera", Severity.WARNING, said, ground=ground, said=said)


class TurnWatch:
    """Says once if pictures are turned against the autopilot's heading: then each is levelled along wrong axes, and the
    heading keeps matches from being found. Either the camera's top points elsewhere than `source.up_deg` says, or the
    compass is wrong."""

    def __init__(self, herald: Herald, source: SourceConfig) -> None:
        self._herald, self._up_deg, self._is_said = herald, source.up_deg, False
        self._turned: deque[complex] = deque(maxlen=_TURNED_BY)  # each of length 1

    def tell(self, event: Recognition) -> None:
        """Take the direction that the match of an event shows."""
        where, told_deg = event.located, event.view.up_deg
        if self._is_said or where is None or where.heading_deg is None or told_deg is None or event.view.reason:
            return
        self._turned.append(cmath.rect(1.0, math.radians(where.heading_deg - told_deg)))
        mean = sum(self._turned) / _TURNED_BY
        turn_deg = math.degrees(cmath.phase(mean))
        if len(self._turned) < _TURNED_BY or abs(mean) < _AGREE or abs(turn_deg) < _TURNED_DEG:
            return
        self._is_said, up_deg = True, (self._up_deg + turn_deg) % 360
        turned = f"turned {turn_deg:.0f} degrees"
        said = f"pictures are {turned} against the heading: if the compass is right, set source.up_deg: {up_deg:.0f}"
        self._herald.tell("camera", Severity.WARNING, said, ground=f"pictures {turned}", topic="turn", said=said)
