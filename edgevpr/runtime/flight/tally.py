"""Counting the events of a flight."""

import logging

from edgevpr.runtime.recognise.recognition import Recognition

FAILURES_IN_A_ROW = 10  # one may be a bad frame; so many are a fault of the camera, the map or the technique
NOTHING_IN_A_ROW = 10  # likewise of pictures that say nothing

_log = logging.getLogger(__name__)


class Tally:
    """Counts the events of a flight: `queries` and how many of them were `accepted`; `unusable` frames, which never
    became a query; `failed` queries; `failed_in_a_row`, the latest events that all failed; and `nothing_in_a_row`, the
    latest pictures that all said nothing."""

    def __init__(self) -> None:
        self._trouble: str | None = None
        self.queries = self.accepted = self.unusable = self.failed = 0
        self.failed_in_a_row = self.nothing_in_a_row = 0

    def tell(self, event: Recognition) -> None:
        """Count an event. A failure is logged, but only once for failures in a row with the same reason."""
        trouble = event.reason if event.failed else None
        if trouble and trouble != self._trouble:
            _log.warning("%s", trouble)
        self._trouble = trouble
        self.queries += event.is_query
        self.accepted += event.accepted
        self.unusable += not event.is_query
        self.failed += event.is_query and event.failed
        self.failed_in_a_row = self.failed_in_a_row + 1 if event.failed else 0
        self.nothing_in_a_row = self.nothing_in_a_row + 1 if event.says_nothing else 0

    @property
    def is_failing(self) -> bool:
        """True where the last `FAILURES_IN_A_ROW` events, or more, have all failed."""
        return self.failed_in_a_row >= FAILURES_IN_A_ROW

    @property
    def sees_nothing(self) -> bool:
        """True where the last `NOTHING_IN_A_ROW` pictures, or more, have all said nothing."""
        return self.nothing_in_a_row >= NOTHING_IN_A_ROW
