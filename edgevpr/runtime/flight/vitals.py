"""Reports the state of a flight once a second: to systemd (with its watchdog), the autopilot and the status file."""

import logging
import math
import sys
from collections.abc import Callable, Sequence
from datetime import datetime, timezone
from typing import Any

from edgevpr import __version__
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.frames.shot import Condition
from edgevpr.mavlink.messages import Health, Severity
from edgevpr.power.meter import MachineLoad
from edgevpr.runtime.flight import systemd
from edgevpr.runtime.flight.autopilot import combine_confidence
from edgevpr.runtime.flight.clock import Pace
from edgevpr.runtime.flight.companionwatch import CompanionWatch
from edgevpr.runtime.flight.flightio import FlightParts
from edgevpr.runtime.flight.frozenwatch import FrozenWatch
from edgevpr.runtime.flight.notifier import Alert, Commands
from edgevpr.runtime.flight.watching import MAX_BLANK_IN_A_ROW, MAX_FAILURES_IN_A_ROW, Tally
from edgevpr.runtime.recognise.recognition import Recognition, to_fields

_REPORT_INTERVAL_S = 1.0
_MINUTE_S = 60.0
_CAMERA_START_TIMEOUT_S = 10.0
# Without a query from a live camera for this long, something hangs: longer than a query takes on the slowest board, and
# than this many intervals between queries.
_QUERY_TIMEOUT_S = 45.0
_QUERY_TIMEOUT_INTERVALS = 3
_FAULTS = {Condition.LOST: "lost", Condition.FROZEN: "frozen", Condition.DAMAGED: "damaged", Condition.LATE: "late"}
_QUERY_FIELDS = ("query", "accepted", "reason", "place", "reference_image", "score", "accuracy_m")  # of the status

_log = logging.getLogger(__name__)


class Vitals:
    """Pings the systemd watchdog while queries arrive, or a reported condition explains why none does. Reports the
    state once a second, and once a minute also on a terminal. Notifies once when the camera is lost, frozen, damaged
    or blank, when recognition keeps failing, when this computer is hot, throttled or under-voltage, and when each of
    these is over. `remarks` returns sentences for the status (None: omitted)."""

    def __init__(
        self,
        parts: FlightParts,
        frozen: FrozenWatch,
        *,
        tally: Tally,
        pace: Pace,
        commands: Commands,
        remarks: Callable[[], Sequence[str | None]],
    ) -> None:
        self._parts, self._frozen, self._tally, self._pace = parts, frozen, tally, pace
        self._commands, self._remarks = commands, remarks
        self._watchdog_s = systemd.watchdog_interval_s()
        self._watchdog_due_s = self._report_due_s = parts.io.clock.mono_s()
        self._minute_due_s = self._report_due_s + _MINUTE_S if sys.stderr.isatty() else math.inf
        self._source_fault: str | None = None
        self._start_s = self._last_explained_s = self._report_due_s
        self._is_logging = True
        failing = Reason(ReasonCode.FRAMES_FAILING, {"frames": MAX_FAILURES_IN_A_ROW})
        self._failing = Alert(parts.notifier, "failing", failing, ReasonCode.FRAMES_RECOVERED)
        self._no_texture = Alert(parts.notifier, "camera", Reason(ReasonCode.IMAGE_BLANK), ReasonCode.GROUND_VISIBLE)
        self._companion = CompanionWatch(parts.notifier)
        self._has_event = False
        self._newest: dict[str, Any] | None = None
        self._match: dict[str, Any] | None = None

    def update(self, event: Recognition) -> None:
        """Store an event for the status if it is a query."""
        self._has_event = True
        if event.frame and event.is_query:
            fields, confidence = to_fields(event), combine_confidence(event)
            newest = {"t_frame_s": event.frame.t_mono_s, **{name: fields[name] for name in _QUERY_FIELDS}}
            self._newest = newest | {"confidence": confidence}
            self._match = self._newest if event.accepted else self._match

    def beat(self) -> None:
        """Ping the watchdog and report, if due, and log the answers to fixes. Call it in every pass of the loop."""
        now_s = self._parts.io.clock.mono_s()
        if self._watchdog_s and now_s >= self._watchdog_due_s and self._is_silence_explained(now_s):
            systemd.notify(WATCHDOG=1)
            self._watchdog_due_s = now_s + self._watchdog_s
        if self._parts.autopilot:
            self._parts.autopilot.log_answers()
        if now_s >= self._report_due_s:
            self._report_due_s = now_s + _REPORT_INTERVAL_S
            self._parts.flight_log.sync_if_due(now_s)
            self._report()

    def _is_silence_explained(self, now_s: float) -> bool:
        """Return True if queries arrive, or a reported condition explains why none does."""
        is_awaited = self._parts.source.is_live and not (self._source_fault or self._commands.is_paused)
        if self._has_event or not is_awaited:
            self._last_explained_s, self._has_event = now_s, False
        return now_s - self._last_explained_s < max(_QUERY_TIMEOUT_S, _QUERY_TIMEOUT_INTERVALS / self._pace.rate_hz)

    def _report(self) -> None:
        parts = self._parts
        parts.meter.measure_heat()
        self._companion.take(parts.io.clock.mono_s(), parts.meter.thermal)
        self._check_source()
        self._failing.update(self._tally.failed_in_a_row >= MAX_FAILURES_IN_A_ROW)
        self._check_log()
        self._no_texture.update(self._tally.blank_in_a_row >= MAX_BLANK_IN_A_ROW)
        health, load = self._assess_health(), parts.io.machine.measure_load()
        status = self._make_status(health, load)
        systemd.notify(STATUS=status["summary"])
        if status["t_mono_s"] >= self._minute_due_s:
            self._minute_due_s += _MINUTE_S
            _log.info("%.0f min: %s", status["elapsed_s"] / 60, status["summary"])
        if parts.io.status:
            parts.io.status.write(status)
        if parts.autopilot:
            parts.autopilot.report(health, load, parts.meter.thermal.temperature_c, is_paused=self._commands.is_paused)

    def _check_source(self) -> None:
        source = self._parts.source
        condition = source.condition
        fault = _FAULTS.get(condition)
        if condition is Condition.OPENING and self._report_due_s - self._start_s > _CAMERA_START_TIMEOUT_S:
            fault = "has no picture yet"
        if fault == self._source_fault:
            return
        self._source_fault = fault
        is_unopened = source.condition is Condition.LOST and not self._tally.queries  # then its state is the cause
        self._parts.notifier.log("source", condition=condition.name, state=source.state, refused=source.refused)
        severity = Severity.WARNING if fault else Severity.INFO
        gcs_text = f"camera {fault or 'is back'}{f': {source.state}' if is_unopened else ''}"
        self._parts.notifier.announce(severity, f"source: {source.state}", gcs_text=gcs_text, topic="source")

    def _check_log(self) -> None:
        """Report to the ground station when logging fails and when it resumes; the journal has the cause."""
        is_logging = self._parts.io.machine.is_written(self._parts.flight_log)
        if is_logging != self._is_logging:
            self._is_logging = is_logging
            text = f"flight log {'resumed' if is_logging else 'cannot be written'}"
            if self._parts.link:
                self._parts.link.announce(Severity.INFO if is_logging else Severity.WARNING, text, "log")

    def _assess_health(self) -> Health:
        if self._source_fault or self._frozen.is_frozen:
            return Health.CRITICAL
        if self._commands.is_paused:
            return Health.STANDBY
        return Health.CRITICAL if self._failing.is_active or self._no_texture.is_active else Health.ACTIVE

    def _make_status(self, health: Health, load: MachineLoad) -> dict[str, Any]:
        """Return the status of the flight. Keys that are not obvious (null: unknown):
        - `t_mono_s`: `time` on the clock of the frames; `latency_s`: age of the newest picture
        - `asked_rate_hz`: queries per second that the flight aims for
        - `machine_cpu_share` (0..1), `machine_ram_mb` (of `machine_ram_total_mb`): those of all programs
        - `newest`: the last query; `match`: the last accepted one; `link`: see `AutopilotOutput.state` (null: no link)
        - `remarks`: further sentences for operators; `summary`: the most important values in one line.
        """
        parts, tally, thermal = self._parts, self._tally, self._parts.meter.thermal
        totals, now_s = parts.meter.totals(), parts.io.clock.mono_s()
        utc = datetime.fromtimestamp(parts.io.clock.utc_s(), timezone.utc)
        status: dict[str, Any] = {
            "version": __version__,
            "time": utc.isoformat(timespec="seconds").replace("+00:00", "Z"),
            "t_mono_s": now_s,
            "elapsed_s": totals["elapsed_s"],
            "health": health.name,
            "paused": self._commands.is_paused,
            "source": str(self._frozen.reason or parts.source.state),
            "latency_s": parts.source.latency_s,
            "queries": tally.queries,
            "accepted": tally.accepted,
            "failed": tally.failed + tally.unusable,
            "asked_rate_hz": self._pace.rate_hz,
            "rss_mb": parts.io.machine.rss_mb(),
            "machine_cpu_share": sum(load.core_usage) / max(1, len(load.core_usage)),
            "machine_ram_mb": load.ram_used_bytes / 1e6,
            "machine_ram_total_mb": load.ram_total_bytes / 1e6,
            "used_mah": totals["used_mah"],
            "temperature_c": thermal.temperature_c,
            "hot": thermal.hot,
            "throttled": thermal.throttled,
            "under_voltage": thermal.under_voltage,
            "newest": self._newest,
            "match": self._match,
            "link": parts.autopilot.state() if parts.autopilot else None,
            "remarks": [remark for remark in (*self._companion.problems.values(), *self._remarks()) if remark],
        }
        counts = f"{tally.queries} queries, {tally.accepted} accepted, {totals['used_mah']:.2f} mAh"
        fixes = [status["link"]["fixes"]] if status["link"] else []
        return {**status, "summary": "; ".join((status["source"], counts, *fixes, *status["remarks"]))}
