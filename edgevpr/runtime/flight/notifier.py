"""Messages of a flight to its operators. The notifier reports to the journal (the log of the process), the flight log
and the ground station. `Commands` carries out the requests of ground stations."""

import logging
from typing import Any

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.ground import UserCommand
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.messages import MAX_TEXT_BYTES, Severity
from edgevpr.runtime.flight.flightlog import FlightLog

_MAX_GCS_BYTES = MAX_TEXT_BYTES - len("edgevpr: ")  # length limit of a text for the ground station

_log = logging.getLogger(__name__)


class Notifier:
    """Reports the events of a flight. Without a `link`, nothing is sent to the ground station."""

    def __init__(self, flight_log: FlightLog, link: Link | None) -> None:
        self._flight_log, self._link = flight_log, link

    def log(self, kind: str, **fields: Any) -> None:
        """Write a line to the flight log only."""
        self._flight_log.write(kind, **fields)

    def announce(self, severity: Severity, text: str, *, gcs_text: str | None = None, topic: str | None = None) -> None:
        """Write a text to the journal, and queue it, or the shorter `gcs_text`, for the ground station. A queued text
        is replaced by a newer one of the same `topic`."""
        _log.log(logging.INFO if severity is Severity.INFO else logging.WARNING, "%s", text)
        if self._link:
            self._link.announce(severity, gcs_text or text, topic)

    def report(
        self,
        kind: str,
        severity: Severity,
        note: Reason,
        *,
        gcs_text: str | None = None,
        topic: str | None = None,
        **fields: Any,
    ) -> None:
        """Report to flight log, journal and ground station: write a line of `kind` with `note` and `fields` to the
        flight log, and announce the note to the other two. The ground station gets the text `gcs_text` or, if the
        note's sentence is too long, its summary. `topic` defaults to the kind."""
        self.log(kind, note=note, **fields)
        text = str(note)
        gcs_text = gcs_text or (note.code.summary if len(text.encode()) > _MAX_GCS_BYTES else None)
        self.announce(severity, text, gcs_text=gcs_text, topic=topic or kind)


class Alert:
    """Reports a fault once when it begins (`onset`), and once when it ends (`cleared`). `kind`: of its log lines."""

    def __init__(self, notifier: Notifier, kind: str, onset: Reason, cleared: ReasonCode) -> None:
        self.is_active = False
        self._notifier, self._kind, self._onset, self._cleared = notifier, kind, onset, cleared

    def update(self, is_active: bool, **fields: Any) -> None:
        """Set whether the condition holds now. If that has changed, report it, with `fields` in the flight log."""
        if is_active == self.is_active:
            return
        self.is_active = is_active
        note = self._onset if is_active else Reason(self._cleared)
        self._notifier.report(self._kind, Severity.WARNING if is_active else Severity.INFO, note, **fields)


class Commands:
    """Carries out commands of ground stations. While it `is_paused`, no frame is recognised and no fix is sent."""

    def __init__(self, link: Link | None, notifier: Notifier) -> None:
        self.is_paused = False
        self._link, self._notifier = link, notifier

    def obey(self) -> None:
        """Carry out the request received since the last call, if any, then let the link accept new requests."""
        if self._link is None:
            return
        if request := self._link.take_command():
            self._carry_out(*request)
        self._link.accept_commands()

    def _carry_out(self, command: UserCommand, sender: str) -> None:
        was_paused, self.is_paused = self.is_paused, command is UserCommand.PAUSE
        code = ReasonCode.PAUSED_BY_COMMAND if self.is_paused else ReasonCode.RESUMED_BY_COMMAND
        is_new = self.is_paused != was_paused
        self._notifier.log("command", command=command.name, sender=sender, note=Reason(code), is_new=is_new)
        if is_new:  # a command repeated because its answer was lost changes nothing
            text = code.summary
            self._notifier.announce(Severity.INFO, f"{text} by {sender}", gcs_text=text, topic="pause")
