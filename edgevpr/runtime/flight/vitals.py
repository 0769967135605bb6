"""Reporting of how a flight goes, once a second: to systemd (with its watchdog), to the autopilot, and to the status
file. The loop of `flight` uses it."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timezone

from edgevpr import __version__
from edgevpr.frames.shot import Condition
from edgevpr.mavlink.messages import Health, Severity
from edgevpr.power.meter import MachineLoad
from edgevpr.runtime.flight import systemd
from edgevpr.runtime.flight.autopilot import confidence_of
from edgevpr.runtime.flight.clock import Pace
from edgevpr.runtime.flight.commands import Commands
from edgevpr.runtime.flight.herald import Trouble
from edgevpr.runtime.flight.status import SeenQuery, Status
from edgevpr.runtime.flight.watching import FAILURES_IN_A_ROW, NOTHING_IN_A_ROW, Tally
from edgevpr.runtime.flight.world import Crew
from edgevpr.runtime.recognise.recognition import Recognition

_HEALTH_S = 1.0
_WINDOW = 10  # reports, one a second, over which rate and load are averaged
_TROUBLES = {Condition.LOST: "lost", Condition.FROZEN: "frozen", Condition.DAMAGED: "damaged"}


class Vitals:
    """Pings the watchdog of systemd, and reports once a second how the flight goes: to systemd, to the status file, and
    the state of this computer to the autopilot. It reports once, through the herald, when the camera is lost, frozen,
    damaged or shows nothing, when nothing can be recognised any more, and when each of these is over. `remarks` are
    functions that return a sentence for the status, or None."""

    def __init__(
        self, crew: Crew, *, tally: Tally, pace: Pace, commands: Commands, remarks: Sequence[Callable[[], str | None]]
    ) -> None:
        self._crew, self._tally, self._pace, self._commands, self._remarks = crew, tally, pace, commands, remarks
        self._watchdog_s = systemd.watchdog_interval_s()
        self._watchdog_due_s = self._health_due_s = crew.clock.mono_s()
        self._source_trouble: str | None = None
        self._has_log = True
        failing = f"{FAILURES_IN_A_ROW} frames in a row have failed"
        self._failing = Trouble(crew.herald, "failing", failing, "frames are recognised again")
        self._blind = Trouble(crew.herald, "camera", "camera shows nothing", "camera shows ground again")
        self._newest: SeenQuery | None = None
        self._match: SeenQuery | None = None
        self._newest_s = self._match_s = 0.0
        self._looks: deque[tuple[float, int, float]] = deque(maxlen=_WINDOW + 1)

    def tell(self, event: Recognition) -> None:
        """Take the newest query, and the newest match, from an event."""
        if event.frame is None or not event.is_query:
            return
        self._newest, self._newest_s = _seen(event), event.frame.t_mono_s
        if event.accepted:
            self._match, self._match_s = self._newest, self._newest_s

    def beat(self) -> None:
        """Ping the watchdog and report, if due, and log the answers to fixes that have come. Call it in every pass of
        the loop."""
        now_s = self._crew.clock.mono_s()
        if self._watchdog_s and now_s >= self._watchdog_due_s:
            systemd.watchdog_ping()
            self._watchdog_due_s = now_s + self._watchdog_s
        self._crew.autopilot.log_answers()
        if now_s >= self._health_due_s:
            self._health_due_s = now_s + _HEALTH_S
            self._crew.flight_log.sync_due(now_s)
            self._report()

    def _report(self) -> None:
        meter = self._crew.meter
        meter.look_at_heat()
        self._look_at_source()
        self._failing.note(self._tally.failed_in_a_row >= FAILURES_IN_A_ROW)
        self._look_at_log()
        self._blind.note(self._tally.nothing_in_a_row >= NOTHING_IN_A_ROW)
        health, load = self._health(), meter.machine_load()
        status = self._status(health, load)
        systemd.status(status.summary)
        if self._crew.status:
            self._crew.status.tell(status)
        self._crew.autopilot.report(health, load, meter.thermal.temperature_c)

    def _look_at_source(self) -> None:
        source = self._crew.source
        trouble = _TROUBLES.get(source.condition)
        if trouble == self._source_trouble:
            return
        self._source_trouble = trouble
        self._crew.herald.tell(
            "source",
            Severity.WARNING if trouble else Severity.INFO,
            f"source: {source.state}",
            ground=f"camera {trouble or 'is back'}",
            state=source.state,
            refused=source.refused,
        )

    def _look_at_log(self) -> None:
        """Report to the ground station if the flight log cannot be written, and when it can again; the journal has the
        reason."""
        has_log = self._crew.flight_log.is_written
        if has_log != self._has_log:
            self._has_log = has_log
            text = f"flight log {'is written again' if has_log else 'cannot be written'}"
            self._crew.herald.announce(Severity.INFO if has_log else Severity.WARNING, text, "log")

    def _health(self) -> Health:
        if self._source_trouble:
            return Health.CRITICAL
        if self._commands.is_paused:
            return Health.STANDBY
        return Health.CRITICAL if self._failing.is_so or self._blind.is_so else Health.ACTIVE

    def _status(self, health: Health, load: MachineLoad) -> Status:
        crew, tally = self._crew, self._tally
        totals, now_s = crew.meter.totals(), crew.clock.mono_s()
        rate_hz, cpu_cores = self._lately(totals["elapsed_s"], totals["process_cpu_s"])
        utc = datetime.fromtimestamp(crew.clock.utc_s(), timezone.utc)
        return Status(
            version=__version__,
            time=utc.isoformat(timespec="seconds").replace("+00:00", "Z"),
            elapsed_s=totals["elapsed_s"],
            health=health.name,
            paused=self._commands.is_paused,
            source=crew.source.state,
            latency_s=crew.source.latency_s,
            queries=tally.queries,
            accepted=tally.accepted,
            failed=tally.failed + tally.unusable,
            rate_hz=rate_hz,
            asked_rate_hz=self._pace.rate_hz,
            cpu_cores=cpu_cores,
            rss_mb=crew.meter.rss_mb(),
            machine_cpu_share=sum(load.core_shares) / max(1, len(load.core_shares)),
            machine_ram_mb=load.ram_used_bytes / 1e6,
            machine_ram_total_mb=load.ram_total_bytes / 1e6,
            used_mah=totals["used_mah"],
            temperature_c=crew.meter.thermal.temperature_c,
            throttled=crew.meter.thermal.throttled,
            newest=self._newest and replace(self._newest, age_s=now_s - self._newest_s),
            match=self._match and replace(self._match, age_s=now_s - self._match_s),
            link=crew.autopilot.state(),
            remarks=[text for remark in self._remarks if (text := remark())],
        )

    def _lately(self, elapsed_s: float, cpu_s: float) -> tuple[float | None, float | None]:
        """Return (queries per second, cores kept busy) since the oldest measurement kept, (None, None) if there is no
        other."""
        self._looks.append((elapsed_s, self._tally.queries, cpu_s))
        begin_s, queries, begin_cpu_s = self._looks[0]
        span_s = elapsed_s - begin_s
        if span_s <= 0:
            return None, None
        return (self._tally.queries - queries) / span_s, (cpu_s - begin_cpu_s) / span_s


def _seen(event: Recognition) -> SeenQuery:
    best, here = event.best, event.position
    return SeenQuery(
        query=event.name,
        age_s=0.0,
        accepted=event.accepted,
        reason=event.reason,
        place=best.place.place_id if best else None,
        reference_image=best.place.source_image if best else None,
        score=best.match.score if best else None,
        confidence=confidence_of(event),
        lat_deg=here.lat_deg if here else None,
        lon_deg=here.lon_deg if here else None,
        accuracy_m=event.accuracy_m,
    )
