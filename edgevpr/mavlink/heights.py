"""Height above the ground: from a range finder or terrain data while these are recent, otherwise above the take-off
point. An autopilot's relative altitude depends on its home, and its altitude above sea level on the origin of its
filter. Both can be set in flight (ArduPilot `AP_AHRS::get_relative_position_D_home`, PX4 `GLOBAL_POSITION_INT.hpp`), so
`Heights` sums the changes of whichever altitude agrees with the reported climb rate."""

import logging
import math
from typing import NamedTuple

from edgevpr.mavlink.ground import Announce
from edgevpr.mavlink.messages import Severity
from edgevpr.mavlink.vehicle import Attitude
from edgevpr.mavlink.wire import Message, mavlink

RANGE_MAX_AGE_S = 1.0
TERRAIN_MAX_AGE_S = 2.5
BAD_SIGNAL_QUALITY = 1  # DISTANCE_SENSOR: 0 is unknown, 100 the best
# A disarmed vehicle is assumed to be on the ground unless it moves: it may glide, or be carried by another vehicle.
MAX_STANDING_SPEED_M_S = 3.0
MAX_STANDING_CLIMB_M_S = 1.0
# A change in altitude between two reports that differs from the reported climb by more than this is a jump, unless the
# reports are so far apart that the climb between them is unknown.
MIN_JUMP_M = 2.0
JUMP_M_PER_S = 5.0
MAX_STEP_S = 5.0
MIN_CONTRADICTION_M = 5.0
CONTRADICTION_RATIO = 0.25
MIN_CONTRADICTION_S = 3.0  # longer than a flight over a house

_log = logging.getLogger(__name__)


class Altitudes(NamedTuple):
    """Altitudes at time `t_s` in metres above sea level (None: without a position) and home, and the climb rate."""

    t_s: float
    above_sea_m: float | None
    above_home_m: float
    climb_m_s: float


class Heights:
    """Tracks the height above the ground across changes of home and origin. The height is 0 while the vehicle stands on
    the ground, disarmed. If the first report arrives in flight, tracking starts from its height above home.

    `takeoff_m`: height above the take-off point (None: no report yet). `jumped_m`: sum of altitude jumps since take-off
    that neither a new home nor a new origin explains; they are not included in the height. `stepped_m`: sum of the
    steps of the height where its source changed, which are differences between sources. `contradiction_m`:
    difference from the range finder, if it has persisted for seconds (None: they agree)."""

    def __init__(self, announce: Announce) -> None:
        self._announce = announce
        self.takeoff_m: float | None = None
        self.jumped_m = self.stepped_m = 0.0
        self._source: tuple[str, float] | None = None  # of the height, and how much higher it is than `takeoff_m`
        self._range_offset_m = 0.0  # the same of the range finder, when it measured
        self.contradiction_m: float | None = None
        self._last: Altitudes | None = None
        self._is_standing = self._has_home = self._is_guess = self._has_jumped = False
        self._range: tuple[float, float] | None = None  # metres, time
        self._terrain: tuple[float, float] | None = None  # altitude of the ground below in metres, time
        self._takeoff_terrain_m: float | None = None  # altitude of the take-off point in the same terrain data
        self._changing_since_s: float | None = None  # when the range finder began to disagree with `contradiction_m`

    def handle(self, message: Message, now_s: float, attitude: Attitude | None) -> None:
        """Process a TERRAIN_REPORT or a DISTANCE_SENSOR; `attitude` (None: unknown) corrects the slant range."""
        if message.get_type() == "TERRAIN_REPORT":
            self._handle_terrain(message, now_s)
        elif message.orientation == mavlink.MAV_SENSOR_ROTATION_PITCH_270:
            in_range = message.min_distance < message.current_distance < message.max_distance
            is_good = in_range and message.signal_quality != BAD_SIGNAL_QUALITY
            tilts_deg = (attitude.roll_deg, attitude.pitch_deg) if attitude else ()
            slant = math.prod(math.cos(math.radians(tilt_deg)) for tilt_deg in tilts_deg)
            self._range = (message.current_distance / 100 * max(0.0, slant), now_s) if is_good else None
            if self._range:
                self._range_offset_m = self._range[0] - (self.takeoff_m or 0.0)

    def handle_altitudes(self, altitudes: Altitudes, is_armed: bool, speed_m_s: float) -> None:
        """Process the altitudes of a GLOBAL_POSITION_INT; `speed_m_s` is its ground speed."""
        # PX4 without a home reports the altitude above sea level as the altitude above home.
        was_without_home = not self._has_home
        self._has_home |= altitudes.above_sea_m != altitudes.above_home_m
        is_still = speed_m_s <= MAX_STANDING_SPEED_M_S and abs(altitudes.climb_m_s) <= MAX_STANDING_CLIMB_M_S
        self._is_standing = is_still and not is_armed
        if self._is_standing:
            self.takeoff_m, self.jumped_m, self._is_guess = 0.0, 0.0, False
            self._takeoff_terrain_m = self._get_recent(self._terrain, altitudes.t_s, TERRAIN_MAX_AGE_S)
        elif self.takeoff_m is None or self._last is None:
            self.takeoff_m, self._is_guess = altitudes.above_home_m, True
        elif self._is_guess and was_without_home and self._has_home:
            self.takeoff_m = altitudes.above_home_m
        else:
            self.takeoff_m += self._compute_change_m(self._last, altitudes)
        self._last = altitudes
        self._check_range(altitudes.t_s)
        self._sum_steps(altitudes.t_s)

    def compute_height_m(self, now_s: float) -> float:
        """Return the height above the ground in metres from the best recent source."""
        measured_m = self._get_recent(self._range, now_s, RANGE_MAX_AGE_S)
        return self._compute_autopilot_height_m(now_s) if measured_m is None else measured_m

    def _sum_steps(self, now_s: float) -> None:
        """Add the step of the height to `stepped_m` if its source has changed since the last report."""
        name, offset_m = "take-off", 0.0
        if self._get_recent(self._range, now_s, RANGE_MAX_AGE_S) is not None:
            name, offset_m = "range finder", self._range_offset_m
        elif (terrain_offset_m := self._find_terrain_offset_m(now_s)) is not None:
            name, offset_m = "terrain", terrain_offset_m
        if self._source and name != self._source[0]:
            self.stepped_m += offset_m - self._source[1]
        self._source = name, offset_m

    @property
    def doubt_m(self) -> float:
        """Possible error of the height in metres, from its jumps or its contradiction."""
        return max(abs(self.jumped_m), self.contradiction_m or 0.0)

    def _compute_change_m(self, last: Altitudes, altitudes: Altitudes) -> float:
        """Return the change in height since the `last` report, from the altitude above sea level; if that jumped, from
        the altitude above home; if both jumped, from the reported climb rate."""
        step_s = abs(altitudes.t_s - last.t_s)
        climbed_m = step_s * (last.climb_m_s + altitudes.climb_m_s) / 2
        steps_m = [altitudes.above_home_m - last.above_home_m] if self._has_home else []
        if altitudes.above_sea_m is not None and last.above_sea_m is not None:
            steps_m.insert(0, altitudes.above_sea_m - last.above_sea_m)
        jumped_before, self._has_jumped = self._has_jumped, False
        if not steps_m:
            return climbed_m
        limit_m = MIN_JUMP_M + step_s * (JUMP_M_PER_S + abs(altitudes.climb_m_s - last.climb_m_s) / 2)
        for step_m in steps_m:
            if abs(step_m - climbed_m) <= limit_m:
                return step_m
        nearest_m = min(steps_m, key=lambda step_m: abs(step_m - climbed_m))
        self._has_jumped = True
        if step_s > MAX_STEP_S or jumped_before:  # two consecutive jumps: the climb rate is wrong, not the altitude
            return nearest_m
        jump_m = nearest_m - climbed_m
        self.jumped_m += jump_m
        self._report(f"altitude jumped {jump_m:+.0f} m", "jump ignored", "altitude")
        return climbed_m

    def _check_range(self, now_s: float) -> None:
        """Compare the range finder with the autopilot's height. A change counts after it has lasted a few seconds."""
        range_m = self._get_recent(self._range, now_s, RANGE_MAX_AGE_S)
        autopilot_m = self._compute_autopilot_height_m(now_s)
        if range_m is None:
            self._changing_since_s = None
            return
        difference_m = abs(range_m - autopilot_m)
        differs = difference_m > max(MIN_CONTRADICTION_M, CONTRADICTION_RATIO * abs(autopilot_m))
        if differs == (self.contradiction_m is not None):
            self._changing_since_s = None
            self.contradiction_m = difference_m if differs else None
            return
        if self._changing_since_s is None:
            self._changing_since_s = now_s
        if now_s - self._changing_since_s < MIN_CONTRADICTION_S:
            return
        self.contradiction_m, self._changing_since_s = difference_m if differs else None, None
        if differs:
            text = f"height {autopilot_m:.0f} m, range finder {range_m:.0f} m"
            self._report(text, "they contradict each other", "range finder")
        else:
            self._announce(Severity.INFO, "height and range finder agree again", "range finder")

    def _report(self, text: str, consequence: str, topic: str) -> None:
        _log.warning("%s: %s", text, consequence)
        self._announce(Severity.WARNING, text, topic)

    def _handle_terrain(self, report: Message, now_s: float) -> None:
        # A spacing of 0 means that the autopilot has no terrain data at this position.
        is_known = report.spacing and math.isfinite(report.terrain_height + report.current_height)
        self._terrain = (report.terrain_height, now_s) if is_known else None
        if is_known and self._takeoff_terrain_m is None and self.takeoff_m is not None and not self._is_standing:
            # Before version 4.7, ArduPilot's `current_height` depends on home, so it is used only once.
            self._takeoff_terrain_m = report.terrain_height + report.current_height - self.takeoff_m

    def _compute_autopilot_height_m(self, now_s: float) -> float:
        return (self.takeoff_m or 0.0) + (self._find_terrain_offset_m(now_s) or 0.0)

    def _find_terrain_offset_m(self, now_s: float) -> float | None:
        """Return by how much the ground below is lower than the take-off point; None without recent terrain data."""
        terrain_m = self._get_recent(self._terrain, now_s, TERRAIN_MAX_AGE_S)
        return None if terrain_m is None or self._takeoff_terrain_m is None else self._takeoff_terrain_m - terrain_m

    @staticmethod
    def _get_recent(measured: tuple[float, float] | None, now_s: float, max_age_s: float) -> float | None:
        return measured[0] if measured and now_s - measured[1] <= max_age_s else None
