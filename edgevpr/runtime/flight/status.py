"""The status of a flight at one moment, as people and programs beside it are told."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """A query and the place found for it. `age_s` is the time since its frame was taken. `place`, `reference_image` and
    `score` are None where no place was found, `confidence` where the technique has none, and the position and its
    `accuracy_m` where no match with a position was accepted."""

    query: str
    age_s: float
    accepted: bool
    reason: str
    place: int | None
    reference_image: str | None
    score: float | None
    confidence: float | None
    lat_deg: float | None
    lon_deg: float | None
    accuracy_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkState:
    """State of the link to the flight controller. `trouble` is why it is not open, `autopilot` the system id of the one
    that is heard (each None: there is none), and `channel` how positions are told. `fixes` says in a few words what
    became of them, and `answers` counts those to them by result. `accuracy_m` is how well the navigation knows the
    position (one axis, 1 sigma; None: it is not known)."""

    connected: bool
    trouble: str | None
    autopilot: int | None
    channel: str
    fixes: str
    answers: dict
    unanswered: int
    accuracy_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """Status of a flight.

    `time` is UTC, `elapsed_s` that of the flight. `health` is that of the heartbeats, and `source` says how frames
    come. `rate_hz` are the queries a second, and `cpu_cores` the cores that this process has kept busy, both over the
    last ten seconds (None: too early); `asked_rate_hz` is the rate that the flight now tries to keep. `latency_s` is
    how old the newest picture was when it could be read. `machine_cpu_share` (0..1) and `machine_ram_mb` are those of
    all programs, of `machine_ram_total_mb`. `throttled`: the board slows itself down (None: it cannot tell). `newest`
    is the last query, `match` the last that was accepted. `link` is None without one. `remarks` say what else people
    are to know.
    """

    version: str
    time: str
    elapsed_s: float
    health: str
    paused: bool
    source: str
    latency_s: float | None
    queries: int
    accepted: int
    failed: int
    rate_hz: float | None
    asked_rate_hz: float
    cpu_cores: float | None
    rss_mb: float
    machine_cpu_share: float
    machine_ram_mb: float
    machine_ram_total_mb: float
    used_mah: float
    temperature_c: float | None
    throttled: bool | None
    newest: Seen | None
    match: Seen | None
    link: LinkState | None
    remarks: list

    @property
    def summary(self) -> str:
        """The most important of it in one line."""
        counts = f"{self.queries} queries, {self.accepted} accepted, {self.used_mah:.2f} mAh"
        return "; ".join((self.source, counts, *([self.link.fixes] if self.link else []), *self.remarks))
