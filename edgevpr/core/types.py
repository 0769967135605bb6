"""The values that packages pass to each other: frozen dataclasses."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from edgevpr.core.contract import FineMatch

# ArduPilot treats an older frame as 5 s old, and would then correct the position by too little: no such fix is sent.
FIX_MAX_AGE_S = 5.0
_FRESH_S = 1.0


@dataclass(frozen=True, slots=True)
class Position:
    """A point on the WGS-84 ellipsoid; `alt_m` is metres above sea level, None where unknown."""

    lat_deg: float
    lon_deg: float
    alt_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """The way in which a picture lies on the ground, for a camera that looks straight down. `up_deg` is the compass
    direction (0..360) of the top of the picture, and `footprint_m` the length on the ground of its longest side. The
    middle of the picture is the place's position, with `covariance_m2` (variance east, covariance, variance north).
    `is_surveyed`: cut from a geo-referenced picture, so that nothing is left to refine. `recorded` is the position as
    it was before it was refined (None: it was not moved)."""

    up_deg: float
    footprint_m: float
    covariance_m2: tuple[float, float, float]
    is_surveyed: bool = False
    recorded: Position | None = None


@dataclass(frozen=True, slots=True)
class Receiver:
    """Position of a GPS receiver, with the standard deviation of one axis, and the time at which it was new."""

    lat_deg: float
    lon_deg: float
    sd_m: float
    t_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """The state of the aircraft as the autopilot reports it: estimated position (degrees, metres above sea level),
    heading of the nose (0..360 clockwise from north, None: unknown), and `t_heard_s`, the time of the report on the
    clock of the frames. `has_gps`: at that time a receiver had a 3D fix near that position. Without `has_gps` the
    position may be wrong: an autopilot goes on reporting its estimate long after it has lost GPS, and it does not
    follow a receiver that it does not trust. `roll_deg` (right wing down is positive), `pitch_deg` (nose up),
    `height_m` above the ground, `velocity_m_s` over it (east, north) and `sink_m_s` (down) are None where unknown.
    `position_sd_m` is the standard deviation of one axis of the position, None where it is unknown or the autopilot has
    no position of its own to rely on. `gps` is the newest position of a receiver, near
    that position or not (None: there is none that is new), and `t_fix_s` when the newest fix of ours was sent or taken
    that may be in the position (-inf: none is)."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    heading_deg: float | None
    t_heard_s: float
    has_gps: bool
    roll_deg: float | None = None
    pitch_deg: float | None = None
    height_m: float | None = None
    velocity_m_s: tuple[float, float] | None = None
    sink_m_s: float | None = None
    position_sd_m: float | None = None
    gps: Receiver | None = None
    t_fix_s: float = -math.inf

    def is_fresh_at(self, t_mono_s: float) -> bool:
        """Tell whether the report came within one second of `t_mono_s`, such as the time of a frame."""
        return abs(t_mono_s - self.t_heard_s) <= _FRESH_S


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One picture and its known data (None: unknown). `image` is uint8, (H, W) grey or (H, W, 3) BGR. `t_mono_s` is
    seconds of the monotonic clock, `t_utc_s` seconds since 1970, `heading_deg` 0..360 clockwise from true north.
    `roll_deg` (right wing down is positive) and `pitch_deg` (nose up) are those of the airframe or, of a camera on a
    gimbal, its deviation from straight down; `height_m` is above the ground. `pose` is how the picture lies on the
    ground."""

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


@dataclass(frozen=True, slots=True)
class Salience:
    """MS, SS and ES of a frame (thesis 3.2.4), each 0..1: how memorable, static and full of information it is; None for
    what was not looked at. `is_low`: it passed only because there would have been too wide a gap without it."""

    memorability: float | None
    staticity: float | None
    entropy: float | None
    is_low: bool = False

    @property
    def scores(self) -> dict[str, float | None]:
        """Return the three scores by their names."""
        return {"memorability": self.memorability, "staticity": self.staticity, "entropy": self.entropy}

    def rounded(self) -> dict[str, float | None]:
        """Return the scores as they are written for people and programs: four digits."""
        return {name: score if score is None else round(score, 4) for name, score in self.scores.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A place of the map without its descriptors, which are read separately. Units are those of `Frame`. `salience` is
    None where the map was made without that gate, and `pose` where it is not known how the picture lies on the
    ground."""

    place_id: int
    source_image: str
    position: Position | None = None
    t_utc_s: float | None = None
    heading_deg: float | None = None
    quality: float = 1.0
    salience: Salience | None = None
    pose: Pose | None = None


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place that may be the one in the query, and its match. Retrieval returns candidates best first."""

    place: Place
    match: FineMatch


@dataclass(frozen=True, slots=True)
class StageCost:
    """Cost of one stage: wall seconds, and CPU-seconds of all threads of the process."""

    wall_s: float
    cpu_s: float

    def __add__(self, other: "StageCost") -> "StageCost":
        return StageCost(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)

    def __mul__(self, times: float) -> "StageCost":
        return StageCost(self.wall_s * times, self.cpu_s * times)

    def utilisation(self, cores: int) -> float:
        """Compute U of equation 5.1: the share of the whole machine that was busy, 0..1."""
        return min(1.0, self.cpu_s / (self.wall_s * cores)) if self.wall_s > 0 else 0.0


NO_COST = StageCost(0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Steps:
    """Costs of the steps of one query: `read` the picture (in a flight only), `prepare` it (level it on the ground),
    look whether it passes the `gate`, `encode` it, `scan` all places, `compare` and judge the candidates, `verify` the
    best one by its landmarks, and `locate` the aircraft. A step that the query did not reach has no cost."""

    read: StageCost = NO_COST
    prepare: StageCost = NO_COST
    gate: StageCost = NO_COST
    encode: StageCost = NO_COST
    scan: StageCost = NO_COST
    compare: StageCost = NO_COST
    verify: StageCost = NO_COST
    locate: StageCost = NO_COST

    @property
    def encoding(self) -> StageCost:
        """Cost of encoding as the thesis defines it: everything before matching."""
        return self.prepare + self.gate + self.encode

    @property
    def match(self) -> StageCost:
        """Cost of matching as the thesis defines it: everything after encoding."""
        return self.scan + self.compare + self.verify + self.locate


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryCost:
    """Cost of one query by equations 5.1-5.7: times, utilisations of all cores, memory, charge drawn from the pack.

    `rss_mb` is read at the query. `pss_mb`, with shared pages in proportion, may be some seconds old (None: the kernel
    does not report it).
    """

    t_encode_s: float
    t_match_s: float
    u_encode: float
    u_match: float
    cpu_s: float
    rss_mb: float
    used_mah: float
    marginal_mah: float
    pss_mb: float | None = None

    @property
    def whole(self) -> StageCost:
        """Cost of both stages together."""
        return StageCost(self.t_encode_s + self.t_match_s, self.cpu_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class FixReport:
    """The outcome of the position fix of a `query`. `sent` is True, False (`why` gives the reason), or None while the
    fix waits to be sent or, over TCP, to be confirmed by the other end. `answer` is the answer of the autopilot, the
    name of a MAV_RESULT; None: no answer (yet). `lat_deg`, `lon_deg` and `accuracy_m` are what it says (None: there was
    nothing to be sent)."""

    query: str
    sent: bool | None
    why: str | None = None
    answer: str | None = None
    lat_deg: float | None = None
    lon_deg: float | None = None
    accuracy_m: float | None = None


T = TypeVar("T")


class Tape(Protocol):
    """Takes note of what comes in, or gives it back. All values are those of JSON, or bytes."""

    def read(self, kind: str, look: Callable[[], T]) -> T:
        """Return what `look` finds; or, of a flight that is run again, what it found then."""
        ...

    def note(self, kind: str, *values: Any) -> None:
        """Take note of what has happened without being asked for, in another thread."""
        ...


class NoTape:
    """Stands in for a `Tape` where nothing is recorded."""

    def read(self, kind: str, look: Callable[[], T]) -> T:
        """Return what `look` finds."""
        return look()

    def note(self, kind: str, *values: Any) -> None:
        """Take note of nothing."""


NO_TAPE = NoTape()
