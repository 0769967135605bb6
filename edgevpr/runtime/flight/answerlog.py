"""The lines of the flight log for the answers to fixes, each written as the answer comes."""

from edgevpr.mavlink.outbox import Sending
from edgevpr.runtime.flight.flightlog import FlightLog


class AnswerLog:
    """Waits for the answers to fixes; `write` adds a line of kind "answer" for each that has come. One thread, that of
    the flight's loop, calls both: it alone writes the log."""

    def __init__(self) -> None:
        self._awaited: list[tuple[str, Sending]] = []

    def wait_for(self, query: str, sending: Sending) -> None:
        """Wait for the answer to the fix of a query. One that was not sent, as the line of its query already says, has
        none."""
        if sending.sent is not False:
            self._awaited.append((query, sending))

    def write(self, flight_log: FlightLog) -> None:
        """Write a line for every fix that was answered since the last call, was not answered in time, or was given up
        before it was sent.

        Its fields are: query, sent, result (the name of a MAV_RESULT; null: no answer), why (null: it was taken),
        latency_ms from sending to answer, t_sent_s on the clock of t_mono_s.
        """
        # An answer can be there a moment before the link has noted that the fix has left.
        settled = [each for each in self._awaited if each[1].sent is False or (each[1].sent and each[1].outcome)]
        for query, sending in settled:
            self._awaited.remove((query, sending))
            outcome = sending.outcome
            latency_s = outcome and outcome.latency_s
            flight_log.write(
                "answer",
                query=query,
                sent=sending.sent,
                result=sending.answer,
                why=outcome.why if outcome else sending.why,
                latency_ms=None if latency_s is None else round(latency_s * 1e3, 1),
                t_sent_s=sending.t_sent_s,
            )
