"""Gathering the status of a flight from all that takes part in it."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timezone

from edgevpr import __version__
from edgevpr.frames.source import Source
from edgevpr.mavlink.messages import Health
from edgevpr.power.load import MachineLoad
from edgevpr.runtime.flight.autopilot import Autopilot, confidence_of
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.commands import Commands
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.pace import Pace
from edgevpr.runtime.flight.status import Seen, Status
from edgevpr.runtime.flight.tally import Tally
from edgevpr.runtime.recognise.recognition import Recognition

_WINDOW = 10  # looks, one a second


class FlightState:
    """Gathers the status of a flight. `remarks` are asked for what else people are to know."""

    def __init__(
        self,
        *,
        source: Source,
        autopilot: Autopilot,
        meter: FlightMeter,
        tally: Tally,
        pace: Pace,
        commands: Commands,
        clock: Clock,
        remarks: Sequence[Callable[[], str | None]] = (),
    ) -> None:
        self._source, self._autopilot, self._meter, self._tally = source, autopilot, meter, tally
        self._pace, self._commands, self._clock, self._remarks = pace, commands, clock, remarks
        self._newest: Seen | None = None
        self._match: Seen | None = None
        self._newest_s = self._match_s = 0.0
        self._looks: deque[tuple[float, int, float]] = deque(maxlen=_WINDOW + 1)

    def tell(self, event: Recognition) -> None:
        """Take note of an event."""
        if not event.is_query:
            return
        self._newest, self._newest_s = _seen(event), event.frame.t_mono_s
        if event.accepted:
            self._match, self._match_s = self._newest, self._newest_s

    def status(self, health: Health, load: MachineLoad) -> Status:
        """Return the status at this moment, once a second. `load` is that of the machine."""
        totals, now_s = self._meter.totals(), self._clock.mono_s()
        rate_hz, cpu_cores = self._lately(totals["elapsed_s"], totals["process_cpu_s"])
        return Status(
            version=__version__,
            time=datetime.fromtimestamp(self._clock.utc_s(), timezone.utc)
            .isoformat(timespec="seconds")
            .replace("+00:00", "Z"),
            elapsed_s=totals["elapsed_s"],
            health=health.name,
            paused=self._commands.is_paused,
            source=self._source.state,
            latency_s=self._source.latency_s,
            queries=self._tally.queries,
            accepted=self._tally.accepted,
            failed=self._tally.failed + self._tally.unusable,
            rate_hz=rate_hz,
            asked_rate_hz=self._pace.rate_hz,
            cpu_cores=cpu_cores,
            rss_mb=self._meter.rss_mb(),
            machine_cpu_share=sum(load.core_shares) / max(1, len(load.core_shares)),
            machine_ram_mb=load.ram_used_bytes / 1e6,
            machine_ram_total_mb=load.ram_total_bytes / 1e6,
            used_mah=totals["used_mah"],
            temperature_c=self._meter.thermal.temperature_c,
            throttled=self._meter.thermal.throttled,
            newest=self._newest and replace(self._newest, age_s=now_s - self._newest_s),
            match=self._match and replace(self._match, age_s=now_s - self._match_s),
            link=self._autopilot.state(),
            remarks=[said for remark in self._remarks if (said := remark())],
        )

    def _lately(self, elapsed_s: float, cpu_s: float) -> tuple[float | None, float | None]:
        """Return the queries a second, and the cores kept busy, since the oldest look that is kept."""
        self._looks.append((elapsed_s, self._tally.queries, cpu_s))
        begin_s, queries, begin_cpu_s = self._looks[0]
        span_s = elapsed_s - begin_s
        if span_s <= 0:
            return None, None
        return (self._tally.queries - queries) / span_s, (cpu_s - begin_cpu_s) / span_s


def _seen(event: Recognition) -> Seen:
    place = event.best and event.best.place
    return Seen(
        query=event.frame.name,
        age_s=0.0,
        accepted=event.accepted,
        reason=event.reason,
        place=place and place.place_id,
        reference_image=place and place.source_image,
        score=event.best and event.best.match.score,
        confidence=confidence_of(event),
        lat_deg=event.position and event.position.lat_deg,
        lon_deg=event.position and event.position.lon_deg,
        accuracy_m=event.accuracy_m,
    )
