"""Frozen dataclasses that the packages exchange."""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.core.contract import FineMatch
from edgevpr.core.reasons import Reason

# ArduPilot treats an older frame as 5 s old and would correct the position by too little, so no such fix is sent.
MAX_FIX_AGE_S = 5.0
_MAX_REPORT_AGE_S = 1.0
FRAME_TIME_SD_S = 0.03  # standard deviation of a frame's time, because exposure and transfer times vary


@dataclass(frozen=True, slots=True)
class Position:
    """A point on the WGS-84 ellipsoid. `alt_m`: metres above sea level, None if unknown."""

    lat_deg: float
    lon_deg: float
    alt_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Orientation and size on the ground of a place's image, for a camera that looks straight down.

    `up_deg`: compass direction (0..360) of the image's top. `footprint_m`: ground length of its longest side.
    `covariance_m2`: covariance (variance east, covariance, variance north) of the place's position, the centre of the
    image. `is_surveyed`: the image was cut from an orthophoto, so the pose needs no refinement. `recorded`: the
    place's position before refinement (None: refinement did not move it)."""

    up_deg: float
    footprint_m: float
    covariance_m2: tuple[float, float, float]
    is_surveyed: bool = False
    recorded: Position | None = None

    @property
    def is_confirmed(self) -> bool:
        """True if direction and size are not only recorded, but those of an orthophoto or found by refinement."""
        return self.is_surveyed or self.recorded is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class Receiver:
    """The newest report of a GPS receiver: standard deviation `sd_m` per axis, arrival time `t_s` on the clock of the
    frames, velocity over ground (east, north), and altitude above sea level (None: unknown). `steady_for_s`: seconds
    for which its fixes have had no gap, jump or implausible accuracy. `age_at_report_s`: age of its fix when its last
    report arrived: autopilots repeat the last fix of a lost receiver for some seconds."""

    lat_deg: float
    lon_deg: float
    sd_m: float
    t_s: float
    velocity_m_s: tuple[float, float] | None = None
    alt_m: float | None = None
    steady_for_s: float = math.inf
    age_at_report_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """The state of the aircraft as the autopilot reports it. None: unknown.

    `lat_deg`, `lon_deg`, `alt_m`: its estimated position (metres above sea level), with the standard deviation
    `position_sd_m` per axis (also None if the autopilot does not trust its position).
    `heading_deg`: compass direction of the nose, 0..360. `t_received_s`: arrival of the report, on the frames' clock.
    `has_gps`: a GPS receiver had a 3D fix near the estimated position at that time. If False, the position may be
    wrong: an autopilot keeps reporting its estimate long after it has lost GPS.
    `roll_deg`, `pitch_deg`: positive for right wing down and for nose up; `tilt_rate_deg_s`: rate of both together.
    `height_m`: above ground; `height_doubt_m`: by how much its sources disagree; `height_step_m`: sum of its steps at
    changes of its source; `heading_step_deg`: sum of the steps of the heading that its rate does not explain.
    `velocity_m_s`: over ground (east, north). `sink_m_s`: velocity down. `innovation_ratio`:
    innovation of measured positions over the filter's gate; above 1 the filter refuses them. `has_position`: the filter
    has a position. `gps`: newest receiver position, near the estimate or not (None: none is recent). `gps_is_silent`:
    reports of a receiver with a fix have stopped, so it is unknown whether it still has one. `reaches_another`: another
    vehicle's autopilot would use our positions as well. `t_fix_s`: time of the newest fix from edgevpr that may already
    affect the position (-inf: none does)."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    heading_deg: float | None
    t_received_s: float
    has_gps: bool
    roll_deg: float | None = None
    pitch_deg: float | None = None
    tilt_rate_deg_s: float = 0.0
    height_m: float | None = None
    height_doubt_m: float = 0.0
    height_step_m: float = 0.0
    heading_step_deg: float = 0.0
    velocity_m_s: tuple[float, float] | None = None
    sink_m_s: float | None = None
    has_position: bool = True
    position_sd_m: float | None = None
    innovation_ratio: float | None = None
    gps: Receiver | None = None
    gps_is_silent: bool = False
    reaches_another: bool = False
    t_fix_s: float = -math.inf

    def is_fresh(self, t_mono_s: float) -> bool:
        """Return True if the report arrived within one second of `t_mono_s`, for example the time of a frame."""
        return abs(t_mono_s - self.t_received_s) <= _MAX_REPORT_AGE_S


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One image and its metadata (None: unknown).

    `image`: uint8, (H, W) grey or (H, W, 3) BGR. `t_mono_s`: capture time, seconds on the monotonic clock; `t_sd_s`:
    its standard deviation; `delay_sd_s`: standard deviation of a further delay that the timestamps of such a camera
    usually hide. `t_utc_s`: seconds since 1970. `heading_deg`: 0..360 clockwise from true north.
    `roll_deg`, `pitch_deg`: attitude of the airframe, positive for right wing down and for nose up; for a camera on a
    gimbal, its deviation from straight down. `height_m`: above ground."""

    image: np.ndarray
    name: str
    t_mono_s: float
    t_utc_s: float | None = None
    position: Position | None = None
    heading_deg: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None
    height_m: float | None = None
    pose: Pose | None = None
    t_sd_s: float = FRAME_TIME_SD_S
    delay_sd_s: float = FRAME_TIME_SD_S


@dataclass(frozen=True, slots=True)
class Salience:
    """MS, SS and ES of a frame (thesis 3.2.4), each 0..1: how memorable, static and rich in information it is (None:
    not computed). `is_low`: the frame is below a threshold and was stored only to bridge a long gap between places."""

    memorability: float | None
    staticity: float | None
    entropy: float | None
    is_low: bool = False

    @property
    def scores(self) -> dict[str, float | None]:
        """Return the three scores by name."""
        return {"memorability": self.memorability, "staticity": self.staticity, "entropy": self.entropy}

    def rounded(self) -> dict[str, float | None]:
        """Return the three scores by name, rounded to four decimals for output."""
        return {name: score if score is None else round(score, 4) for name, score in self.scores.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A place of the map, without its descriptors. Units are as in `Frame`; None: unknown. `place_id`: number in the
    map; `source_image`: name of its image; `quality`: `Descriptor.quality` of its image."""

    place_id: int
    source_image: str
    position: Position | None = None
    t_utc_s: float | None = None
    heading_deg: float | None = None
    quality: float = 1.0
    salience: Salience | None = None
    pose: Pose | None = None

    @property
    def recorded_position(self) -> Position | None:
        """The position before refinement moved it."""
        return self.pose.recorded if self.pose and self.pose.recorded else self.position


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place that the query may show, and the result `match` of comparing the two."""

    place: Place
    match: FineMatch


@dataclass(frozen=True, slots=True)
class StageCost:
    """Cost of one processing stage: elapsed (wall) seconds, and CPU seconds of all threads of the process."""

    wall_s: float
    cpu_s: float

    def __add__(self, other: "StageCost") -> "StageCost":
        return StageCost(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)

    def __mul__(self, times: float) -> "StageCost":
        return StageCost(self.wall_s * times, self.cpu_s * times)

    def utilisation(self, cores: int) -> float:
        """Return U in equation 5.1 of the thesis: the busy fraction of all `cores`, 0..1."""
        return min(1.0, self.cpu_s / (self.wall_s * cores)) if self.wall_s > 0 else 0.0


NO_COST = StageCost(0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepCosts:
    """Costs of the steps of a query: `read` the image, `prepare` it (level it), test its salience (`gate`), `encode`
    it, measure the motion since the previous frame (`odometry`), `scan` all places, `compare` the candidates, `verify`
    the best one by landmarks, `locate` the aircraft. Only flights `read` and measure `odometry`."""

    read: StageCost = NO_COST
    prepare: StageCost = NO_COST
    gate: StageCost = NO_COST
    encode: StageCost = NO_COST
    odometry: StageCost = NO_COST
    scan: StageCost = NO_COST
    compare: StageCost = NO_COST
    verify: StageCost = NO_COST
    locate: StageCost = NO_COST

    @property
    def encoding(self) -> StageCost:
        """Cost of encoding as defined in the thesis: all steps before matching except `read`."""
        return self.prepare + self.gate + self.encode

    @property
    def match(self) -> StageCost:
        """Cost of matching as defined in the thesis: all steps after encoding."""
        return self.odometry + self.scan + self.compare + self.verify + self.locate


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryCost:
    """Cost of one query by equations 5.1-5.7 of the thesis, for the encoding and matching stages.

    `t_*_s`: elapsed seconds. `u_*`: utilisation of all cores, 0..1. `cpu_s`: CPU seconds of both. `rss_mb`: current
    resident memory of the process. `used_mah`: charge drawn from the battery; `marginal_mah`: the part that would not
    have been drawn without the query."""

    t_encode_s: float = 0.0
    t_match_s: float = 0.0
    u_encode: float = 0.0
    u_match: float = 0.0
    cpu_s: float = 0.0
    rss_mb: float = 0.0
    used_mah: float = 0.0
    marginal_mah: float = 0.0

    @property
    def whole(self) -> StageCost:
        """Cost of both stages together."""
        return StageCost(self.t_encode_s + self.t_match_s, self.cpu_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class FixReport:
    """The outcome of the position fix for one query. `query`: name of its frame. `sent`: False if it was not sent, for
    the reason `why`; None while it waits to be sent or, over TCP, acknowledged. `answer`: name of the MAV_RESULT that
    the autopilot returned (None: none yet). `lat_deg`, `lon_deg`, `accuracy_m`: None if there was nothing to send."""

    query: str
    sent: bool | None
    why: Reason | None = None
    answer: str | None = None
    lat_deg: float | None = None
    lon_deg: float | None = None
    accuracy_m: float | None = None
