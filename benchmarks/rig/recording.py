"""What happened, ten times a second: where the aircraft was, and where its autopilot took itself to be."""

import math
import threading
from pathlib import Path

from truth import Truth

from edgevpr.lab.simulate.generated import to_metres
from edgevpr.mavlink.wire import Message

COLUMNS = (
    "t_s", "east_m", "north_m", "height_m", "roll_deg", "pitch_deg", "est_east_m", "est_north_m", "error_m",
    "mode", "ekf_flags", "gps_fix",
)  # fmt: skip
COMPANION = 197


class Recorder:
    """Writes a line for every GLOBAL_POSITION_INT while it `is_on`, and keeps texts, modes and what the companion says.
    `first_s` is when it began."""

    def __init__(self, truth: Truth, path: Path) -> None:
        self._truth, self._lock = truth, threading.Lock()
        self._file = open(path, "w", encoding="utf-8", buffering=1)  # noqa: SIM115 (closed by close)
        self._file.write(",".join(COLUMNS) + "\n")
        self.is_on = False
        self.error_m = math.nan
        self._mode = self._ekf_flags = self._gps_fix = 0
        self.texts: list[tuple[float, int, str]] = []
        self.companion: dict[str, int] = {}  # messages from edgevpr that came through, by name
        self.values: list[tuple[float, str, float]] = []

    def close(self) -> None:
        with self._lock:
            self.is_on = False
            self._file.close()

    def listen(self, message: Message, now_s: float) -> None:
        """Take note of a message."""
        name, sender = message.get_type(), message.get_srcComponent()
        if sender == COMPANION:
            self.companion[name] = self.companion.get(name, 0) + 1
            if name == "NAMED_VALUE_FLOAT":
                self.values.append((now_s, message.name, message.value))
        if name == "STATUSTEXT":
            self.texts.append((now_s, sender, message.text))
        if sender != 1:
            return
        if name == "HEARTBEAT":
            self._mode = message.custom_mode
        elif name == "EKF_STATUS_REPORT":
            self._ekf_flags = message.flags
        elif name == "GPS_RAW_INT":
            self._gps_fix = message.fix_type
        elif name == "GLOBAL_POSITION_INT":
            self._write(message, now_s)

    def line(self) -> str:
        """Tell how it stands, in a few words."""
        return f"error {self.error_m:.1f} m, mode {self._mode}, filter {self._ekf_flags}, gps fix {self._gps_fix}"

    def _write(self, message: Message, now_s: float) -> None:
        true = self._truth.at(now_s)
        if true is None:
            return
        east_m, north_m = to_metres(message.lat / 1e7, message.lon / 1e7)
        self.error_m = math.hypot(east_m - true.east_m, north_m - true.north_m)
        moved = (true.east_m, true.north_m, true.height_m, true.roll_deg, true.pitch_deg, east_m, north_m, self.error_m)
        state = (self._mode, self._ekf_flags, self._gps_fix)
        with self._lock:
            if self.is_on:
                self._file.write(
                    ",".join((f"{now_s:.3f}", *(f"{each:.2f}" for each in moved), *map(str, state))) + "\n"
                )
