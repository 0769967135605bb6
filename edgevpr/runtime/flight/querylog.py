"""The lines of the flight log for events."""

from typing import Any

from edgevpr.frames.source import Source
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.tally import Tally
from edgevpr.runtime.recognise.recognition import Recognition, fields_of


def totals_of(tally: Tally, meter: FlightMeter, source: Source) -> dict[str, Any]:
    """Return the counts and costs of the flight so far: queries, those of `FlightMeter.totals`, the pictures that were
    not read in time (`dropped`) or not new and whole (`refused`, by reason), and the seconds that the newest was old
    when it could be read (`latency_s`)."""
    return {
        "queries": tally.queries,
        **meter.totals(),
        "dropped": source.dropped,
        "refused": dict(source.refused),
        "latency_s": source.latency_s,
    }


class QueryLog:
    """Writes a line for every event: of kind "query", or "unusable" for a frame that never became a query."""

    def __init__(self, flight_log: FlightLog, source: Source, meter: FlightMeter, tally: Tally) -> None:
        self._flight_log, self._source, self._meter, self._tally = flight_log, source, meter, tally

    def tell(self, event: Recognition) -> None:
        """Write the line of an event."""
        if not event.is_query:
            self._flight_log.write("unusable", problem=event.reason)
            return
        self._flight_log.write(
            "query",
            t_frame_s=event.frame.t_mono_s,
            **fields_of(event),
            fix=event.fix,
            last_fix=event.last_fix,
            reading=event.steps.read,
            board=self._meter.heat_fields(),
            hints=event.hints.fields() if event.hints else None,
            totals=totals_of(self._tally, self._meter, self._source),
        )
