"""The state of a flight, reported once a second, and the watchdog's beat."""

import logging

from edgevpr.frames.shot import Condition
from edgevpr.frames.source import Source
from edgevpr.mavlink.messages import Health
from edgevpr.runtime.flight.autopilot import Autopilot, Mood
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.commands import Commands
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.flightstate import FlightState
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.statussocket import Readers
from edgevpr.runtime.flight.systemd import notify, watchdog_interval_s
from edgevpr.runtime.flight.tally import FAILURES_IN_A_ROW, Tally
from edgevpr.runtime.flight.trouble import Trouble

_HEALTH_S = 1.0
_TROUBLES = {Condition.LOST: "lost", Condition.FROZEN: "frozen", Condition.DAMAGED: "damaged"}

_log = logging.getLogger(__name__)


class Vitals:
    """Tells systemd that the loop turns, it and the `readers` how the flight goes, and the autopilot how this companion
    computer is. It tells everybody, once, when the camera is lost, frozen or damaged or shows nothing, when nothing can
    be recognised any more, and when that is over."""

    def __init__(
        self,
        *,
        source: Source,
        flight_log: FlightLog,
        autopilot: Autopilot,
        meter: FlightMeter,
        tally: Tally,
        commands: Commands,
        clock: Clock,
        state: FlightState,
        readers: Readers,
    ) -> None:
        self._source, self._flight_log, self._autopilot = source, flight_log, autopilot
        self._meter, self._tally, self._commands, self._clock = meter, tally, commands, clock
        self._state, self._readers = state, readers
        self._watchdog_s = watchdog_interval_s()
        self._watchdog_due_s = self._health_due_s = clock.mono_s()
        self._trouble: str | None = None
        failing = f"{FAILURES_IN_A_ROW} frames in a row have failed"
        told = {"flight_log": flight_log, "autopilot": autopilot}
        self._failing = Trouble("failing", failing, "frames are recognised again", **told)
        self._has_log = True
        self._blind = Trouble("camera", "camera shows nothing", "camera shows ground again", **told)

    def beat(self) -> None:
        """Send the watchdog's beat and the report, where they are due, and log the answers to fixes that have come."""
        now_s = self._clock.mono_s()
        if self._watchdog_s and now_s >= self._watchdog_due_s:
            notify(WATCHDOG=1)
            self._watchdog_due_s = now_s + self._watchdog_s
        self._autopilot.log_answers(self._flight_log)
        if now_s >= self._health_due_s:
            self._health_due_s = now_s + _HEALTH_S
            self._flight_log.sync_due(now_s)
            self._tell()

    def _tell(self) -> None:
        self._meter.look_at_heat()
        self._say_source()
        self._failing.note(self._tally.is_failing)
        self._say_log()
        self._blind.note(self._tally.sees_nothing)
        health, load = self._health(), self._meter.machine_load()
        status = self._state.status(health, load)
        notify(STATUS=status.summary)
        self._readers.tell(status)
        self._autopilot.report(health, load, self._meter.thermal.temperature_c)

    def _say_source(self) -> None:
        trouble = _TROUBLES.get(self._source.condition)
        if trouble != self._trouble:
            self._trouble = trouble
            _log.warning("source: %s", self._source.state)
            self._flight_log.write("source", state=self._source.state, refused=self._source.refused)
            self._autopilot.announce(Mood.WARNING if trouble else Mood.NOTE, f"camera {trouble or 'is back'}", "source")

    def _say_log(self) -> None:
        """Tell the ground of a flight log that cannot be written; the journal has the reason."""
        has_log = self._flight_log.is_written
        if has_log != self._has_log:
            self._has_log = has_log
            text = f"flight log {'is written again' if has_log else 'cannot be written'}"
            self._autopilot.announce(Mood.NOTE if has_log else Mood.WARNING, text, "log")

    def _health(self) -> Health:
        if self._trouble:
            return Health.CRITICAL
        if self._commands.is_paused:
            return Health.STANDBY
        return Health.CRITICAL if self._failing.is_so or self._blind.is_so else Health.ACTIVE
