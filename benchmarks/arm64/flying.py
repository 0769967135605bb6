"""What a flight does beside its queries: the stride of a frame, and a second of a continuous position."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.frames.level import View
from edgevpr.mavlink import messages
from edgevpr.mavlink.channel import Channel
from edgevpr.mavlink.conversation import Conversation, LinkSettings
from edgevpr.mavlink.wire import Message, mavlink
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.recognise.landmarks import OF_QUERY, describe
from edgevpr.runtime.recognise.stride import Strides

_TENTHS = 10
_HEIGHT_MM, _G = 100_000, -1000
# A second, as both simulators send it with a continuous position: what edgevpr has asked for, and what a PX4 sends
# unasked (see benchmarks/rig).
_ASKED = {
    "ATTITUDE": 25,
    "SCALED_IMU": 25,
    "GLOBAL_POSITION_INT": 10,
    "GPS_RAW_INT": 5,
    "HEARTBEAT": 1,
}
_UNASKED = {
    "HIGHRES_IMU": 50,
    "ATTITUDE_QUATERNION": 50,
    "LOCAL_POSITION_NED": 30,
    "ODOMETRY": 30,
    "ALTITUDE": 10,
    "VFR_HUD": 10,
    "SERVO_OUTPUT_RAW": 10,
    "TIMESYNC": 10,
    "POSITION_TARGET_LOCAL_NED": 10,
    "POSITION_TARGET_GLOBAL_INT": 10,
    "ATTITUDE_TARGET": 10,
}


def parts(picture: Image) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the name of each part, and a function that does it."""
    moved = cv2.warpAffine(picture, np.float32([[1, 0, 40], [0, 1, 15]]), picture.shape[::-1])
    view = View(up_deg=0.0, footprint_m=130.0, aside=(0.0, 0.0), focal=0.77)
    before, now = describe(picture, None, OF_QUERY), describe(moved, None, OF_QUERY)

    def stride() -> object:
        strides = Strides()
        strides.to(0.0, view, before)
        if (found := strides.to(1.0, view, now)) is None:
            raise RuntimeError("no stride was found")
        return found

    yield "flight: landmarks of a frame", lambda: describe(moved, None, OF_QUERY)
    yield "flight: the stride since the frame before", stride
    yield "flight: a second of a continuous position", Second(_ASKED).pass_by
    yield "flight: the same, with what a PX4 sends unasked", Second(_ASKED | _UNASKED).pass_by


class Second:
    """An autopilot's messages of one second, heard by a flight that answers with ten positions."""

    def __init__(self, rates_hz: dict[str, int]) -> None:
        self._now_s = 0.0
        self._navigator = Navigator(1.0, 1.0)
        self._conversation = Conversation(LinkSettings(listener=self._navigator), lambda: self._now_s)
        self._packer = mavlink.MAVLink(None, 1, 1)
        self._tenths = [
            b"".join(
                _message(name).pack(self._packer)
                for name, rate_hz in rates_hz.items()
                for _ in range(rate_hz * tenth // _TENTHS, rate_hz * (tenth + 1) // _TENTHS)
            )
            for tenth in range(_TENTHS)
        ]
        for channel in (Channel.COMMAND, Channel.GPS_INPUT):
            self._navigator.hear_channel(channel)
            for data in self._tenths:
                self._hear(data)
        self.pass_by()

    def pass_by(self) -> None:
        """Hear a second of messages, and make the ten positions."""
        for data in self._tenths:
            self._hear(data)
            if (state := self._navigator.state_at(self._now_s)) is None:
                raise RuntimeError("no position is known")
            messages.gps_input(state, 1, self._now_s, None).pack(self._packer)

    def _hear(self, data: bytes) -> None:
        self._now_s += 1 / _TENTHS
        self._conversation.hear(data, self._now_s, None)


def _message(name: str) -> Message:
    """Return a message with plausible values in the fields that are read, and zeros in the others."""
    kind = next(each for each in mavlink.mavlink_map.values() if each.msgname == name)
    values = {
        "type": 2,
        "autopilot": mavlink.MAV_AUTOPILOT_PX4,
        "mavlink_version": 3,
        "lat": 470_000_000,
        "lon": 80_000_000,
        "base_mode": mavlink.MAV_MODE_FLAG_SAFETY_ARMED,
        "relative_alt": _HEIGHT_MM,
        "fix_type": mavlink.GPS_FIX_TYPE_3D_FIX,
        "h_acc": 1000,
        "zacc": _G,
    }
    fields = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    return kind(**{field: values.get(field, [0] * fields[field] if fields[field] else 0) for field in kind.fieldnames})
