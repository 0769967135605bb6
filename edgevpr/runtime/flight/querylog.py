"""The lines of the flight log for events."""

from edgevpr.frames.source import Source
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.mapstate import MapState
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.tally import Tally
from edgevpr.runtime.recognise.recognition import Recognition, fields_of


class QueryLog:
    """Writes a line for every event: of kind "query", or "unusable" for a frame that never became a query."""

    def __init__(
        self, flight_log: FlightLog, source: Source, meter: FlightMeter, tally: Tally, *, map_state: MapState
    ) -> None:
        self._flight_log, self._source, self._meter, self._tally = flight_log, source, meter, tally
        self._map_state = map_state

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
            totals={
                "queries": self._tally.queries,
                **self._meter.totals(),
                "dropped": self._source.dropped,
                "left_out": self._map_state.left_out,
            },
        )
