"""The lines of the flight log for events."""

from collections.abc import Callable
from typing import Any

from edgevpr.frames.source import Source
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.mapstate import MapState
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.tally import Tally
from edgevpr.runtime.recognise.recognition import Recognition, fields_of


def totals_of(tally: Tally, meter: FlightMeter, source: Source, map_state: MapState) -> dict[str, Any]:
    """Return the counts and costs of the flight so far: queries, those of `FlightMeter.totals`, the pictures that were
    not read in time (`dropped`) or not new and whole (`refused`, by reason), the seconds that the newest was old when
    it could be read (`latency_s`), and the places that were left out."""
    return {
        "queries": tally.queries,
        **meter.totals(),
        "dropped": source.dropped,
        "refused": dict(source.refused),
        "latency_s": source.latency_s,
        "left_out": map_state.left_out,
    }


class QueryLog:
    """Writes a line for every event: of kind "query", or "unusable" for a frame that never became a query. `totals`
    gives those of the flight so far."""

    def __init__(self, flight_log: FlightLog, meter: FlightMeter, totals: Callable[[], dict[str, Any]]) -> None:
        self._flight_log, self._meter, self._totals = flight_log, meter, totals

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
            vehicle=event.vehicle,
            board=self._meter.heat_fields(),
            hints=event.hints.fields() if event.hints else None,
            totals=self._totals(),
        )
