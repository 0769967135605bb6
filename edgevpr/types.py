"""The values that cross rooms: frozen dataclasses."""

from dataclasses import dataclass

import numpy as np

from edgevpr.contract import FineMatch

# ArduPilot takes an older frame for one of 5 s ago, and would set the vehicle back too little: no such fix is sent.
FIX_MAX_AGE_S = 5.0
_FRESH_S = 1.0


@dataclass(frozen=True, slots=True)
class Position:
    """A point on the WGS-84 ellipsoid; `alt_m` is metres above sea level, None where unknown."""

    lat_deg: float
    lon_deg: float
    alt_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """What the autopilot says of the aircraft: where it believes to be (degrees, metres above sea level), where its
    nose points (0..360 clockwise from north, None where it does not know), and when it said so (`t_heard_s`, on the
    clock of the frames). `has_gps`: a receiver had a 3D fix then, and there. An autopilot goes on saying where it
    believes to be long after it has lost that, and does not follow a receiver it does not trust."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    heading_deg: float | None
    t_heard_s: float
    has_gps: bool

    def is_fresh_at(self, t_mono_s: float) -> bool:
        """Say whether this was said within a second of a moment, such as that at which a frame was taken."""
        return abs(t_mono_s - self.t_heard_s) <= _FRESH_S


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One picture and what is known of it. `image` is uint8, (H, W) grey or (H, W, 3) BGR."""

    image: np.ndarray
    name: str
    t_mono_s: float
    t_utc_s: float | None = None
    position: Position | None = None
    heading_deg: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A place of the map as a person knows it (its descriptors are fetched apart)."""

    place_id: int
    source_image: str
    position: Position | None = None
    t_utc_s: float | None = None
    heading_deg: float | None = None
    quality: float = 1.0


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place that may be the one in the query, and how it matches; retrieval returns these best first."""

    place: Place
    match: FineMatch


@dataclass(frozen=True, slots=True)
class StageCost:
    """What one stage cost: wall seconds, and CPU-seconds of all threads of the process."""

    wall_s: float
    cpu_s: float

    def __add__(self, other: "StageCost") -> "StageCost":
        return StageCost(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)

    def __mul__(self, times: float) -> "StageCost":
        return StageCost(self.wall_s * times, self.cpu_s * times)

    def utilisation(self, cores: int) -> float:
        """Reckon U of equation 5.1: the share of the whole machine that was busy, 0..1."""
        return min(1.0, self.cpu_s / (self.wall_s * cores)) if self.wall_s > 0 else 0.0


NO_COST = StageCost(0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Steps:
    """What the steps of one query cost: its picture read (in a flight) and encoded, all places scanned, candidates
    compared and judged; none where the query did not come to it."""

    read: StageCost = NO_COST
    encode: StageCost = NO_COST
    scan: StageCost = NO_COST
    compare: StageCost = NO_COST

    @property
    def match(self) -> StageCost:
        """Give the thesis's matching: everything after encoding."""
        return self.scan + self.compare


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryCost:
    """Cost of one query by equations 5.1-5.7: times, utilisations of all cores, memory, charge drawn from the pack.

    `rss_mb` is now; `pss_mb`, with shared pages in proportion, may be some seconds old (None: the kernel does not say).
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
        """Give both stages as one."""
        return StageCost(self.t_encode_s + self.t_match_s, self.cpu_s)


@dataclass(frozen=True, slots=True)
class FixReport:
    """What became of the position fix of a `query`: `sent` is True, False (and `why`), or None while it waits for its
    turn; `answer` is the autopilot's, the name of a MAV_RESULT, None where there is none (yet)."""

    query: str
    sent: bool | None
    why: str | None = None
    answer: str | None = None
