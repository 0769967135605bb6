"""Messages that are sent by themselves, each at its own interval: as asked for, or the default of the firmware."""

import math

from edgevpr.lab.simulate.flightcontroller.reports import FILTER_REPORTS, REPORTS, SILENT, Moment, heartbeat
from edgevpr.mavlink.wire import Message, mavlink

HEARTBEAT_S = 1.0
_WHERE = {
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION,
    mavlink.MAVLINK_MSG_ID_SIM_STATE,
}


class Streams:
    """The intervals of a link. `is_known` False leaves out every message that tells where the vehicle is."""

    def __init__(self, default_hz: dict[int, float], filter_report: int, is_known: bool) -> None:
        self._reports = {**REPORTS, filter_report: FILTER_REPORTS[filter_report]}
        if not is_known:
            self._reports = {number: report for number, report in self._reports.items() if number not in _WHERE}
        self._default_s = {number: 1 / hz for number, hz in default_hz.items() if number in self._reports}
        self._interval_s = dict(self._default_s)
        self._due_s = dict.fromkeys(self._interval_s, 0.0)
        self._beat_due_s = 0.0

    def knows(self, number: int) -> bool:
        """Tell whether there is such a message."""
        return number in self._reports or number in SILENT

    def ask(self, number: int, interval_us: float, now_s: float) -> bool:
        """Set an interval: -1 ends the stream, 0 is the default; return whether there is such a message."""
        if not self.knows(number):
            return False
        if number in SILENT or not math.isfinite(interval_us):
            return True
        interval_s = self._default_s.get(number, 0.0) if interval_us == 0 else interval_us / 1e6
        if interval_s <= 0:
            self._interval_s.pop(number, None)
        else:
            self._interval_s[number], self._due_s[number] = interval_s, now_s
        return True

    def interval_us(self, number: int) -> int:
        """Return the interval of a stream, -1 where there is none."""
        return round(self._interval_s[number] * 1e6) if number in self._interval_s else -1

    def make(self, number: int, now: Moment) -> Message | None:
        """Make a message that somebody asked for once."""
        return self._reports[number](now) if number in self._reports else None

    def due(self, now: Moment) -> list[Message]:
        """Return what is to be sent now."""
        messages = []
        if now.t_s >= self._beat_due_s:
            self._beat_due_s = max(self._beat_due_s + HEARTBEAT_S, now.t_s)
            messages.append(heartbeat(now))
        for number, interval_s in self._interval_s.items():
            if now.t_s >= self._due_s[number]:
                self._due_s[number] = max(self._due_s[number] + interval_s, now.t_s)
                if message := self._reports[number](now):
                    messages.append(message)
        return messages
