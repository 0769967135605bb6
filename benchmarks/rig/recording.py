"""Records the true and the estimated position of the aircraft, ten times a second, and all text messages."""

import math
import threading
from pathlib import Path

from truth import Truth

from edgevpr.lab.simulate.generated import to_metres
from edgevpr.mavlink.wire import Message, mavlink

EDGEVPR = 197  # MAVLink component id of edgevpr
COLUMNS = ("t_s", "east_m", "north_m", "est_east_m", "est_north_m", "error_m", "mode", "height_m")


class Recorder:
    """Writes a row for every GLOBAL_POSITION_INT while it `is_on`, and keeps all `texts` as (time, component, text).
    `warnings` are texts of edgevpr with severity WARNING or worse."""

    def __init__(self, truth: Truth, path: Path) -> None:
        self._truth, self._lock = truth, threading.Lock()
        self._file = open(path, "w", encoding="utf-8", buffering=1)  # noqa: SIM115 (closed by close)
        self._file.write(",".join(COLUMNS) + "\n")
        self.is_on = False
        self._mode = 0
        self.texts: list[tuple[float, int, str]] = []
        self.warnings: list[str] = []

    def close(self) -> None:
        with self._lock:
            self.is_on = False
            self._file.close()

    def handle_message(self, message: Message, now_s: float) -> None:
        """Record a message of the link."""
        name, sender = message.get_type(), message.get_srcComponent()
        if name == "STATUSTEXT":
            self.texts.append((now_s, sender, message.text))
            if sender == EDGEVPR and message.severity <= mavlink.MAV_SEVERITY_WARNING:
                self.warnings.append(message.text.removeprefix("edgevpr: "))
        elif name == "HEARTBEAT" and sender == 1:
            self._mode = message.custom_mode
        elif name == "GLOBAL_POSITION_INT" and sender == 1 and (true := self._truth.compute_pose(now_s)):
            east_m, north_m = to_metres(message.lat / 1e7, message.lon / 1e7)
            error_m = math.hypot(east_m - true.east_m, north_m - true.north_m)
            values = ",".join(f"{value:.2f}" for value in (true.east_m, true.north_m, east_m, north_m, error_m))
            with self._lock:
                if self.is_on:
                    self._file.write(f"{now_s:.3f},{values},{self._mode},{true.height_m:.2f}\n")
