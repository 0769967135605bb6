"""Parameters of a flight controller, and the messages in which they travel."""

import difflib
import struct

from edgevpr.core.errors import UsageError
from edgevpr.mavlink.wire import Message, mavlink

_NAME_BYTES = 16
_MOST = 2**31 - 1


class Parameters:
    """Named values, each an int or a float for good. `bytewise` (PX4): the bytes of an integer stand in the float of
    the message; else (ArduPilot) the float has the integer's value."""

    def __init__(self, values: dict[str, float], bytewise: bool) -> None:
        self._values = dict(values)
        self._bytewise = bytewise

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def get(self, name: str, default: float) -> float:
        """Return a value, or the default where there is no such parameter."""
        return self._values.get(name, default)

    def set(self, name: str, value: float) -> None:
        """Set the value of a parameter, which must exist."""
        self._values[name] = type(self._values[name])(value)

    def set_written(self, name: str, text: str) -> None:
        """Set a parameter to a number as a user writes it. Raises UsageError for a name that does not exist, and for a
        text that is no value of it."""
        if name not in self._values:
            near = difflib.get_close_matches(name.upper(), self._values, n=1)
            hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(sorted(self._values))}."
            raise UsageError(f"The simulated vehicle has no parameter {name}: {hint}")
        kind = type(self._values[name])
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not -_MOST <= value <= _MOST:  # false for NaN
            wanted = "a whole number" if kind is int else "a number"
            raise UsageError(f"{name}={text}: its value is {wanted}, e.g. {self._values[name]}.")
        self.set(name, value)

    def answer(self, message: Message) -> list[Message]:
        """Return the answers to a PARAM_REQUEST_READ, PARAM_REQUEST_LIST or PARAM_SET; none for an unknown name."""
        names = list(self._values)
        if message.get_type() == "PARAM_REQUEST_LIST":
            return [self._said(name, index) for index, name in enumerate(names)]
        if message.get_type() == "PARAM_REQUEST_READ" and 0 <= message.param_index < len(names):
            return [self._said(names[message.param_index], message.param_index)]
        name = message.param_id
        if name not in self._values:
            return []
        if message.get_type() == "PARAM_SET":
            self.set(name, self._read(message))
        return [self._said(name, names.index(name))]

    def _read(self, message: Message) -> float:
        is_bytes = self._bytewise and message.param_type == mavlink.MAV_PARAM_TYPE_INT32
        return struct.unpack("<i", struct.pack("<f", message.param_value))[0] if is_bytes else message.param_value

    def _said(self, name: str, index: int) -> Message:
        value, is_whole = self._values[name], isinstance(self._values[name], int)
        kind = mavlink.MAV_PARAM_TYPE_INT32 if is_whole else mavlink.MAV_PARAM_TYPE_REAL32
        if is_whole and self._bytewise:
            value = struct.unpack("<f", struct.pack("<i", value))[0]
        return mavlink.MAVLink_param_value_message(
            name.encode()[:_NAME_BYTES], float(value), kind, len(self._values), index
        )


# Those of the simulator itself, under the names of ArduPilot's: the same test can drive both.
SIMULATOR = {
    "SIM_GPS1_ENABLE": 1,
    "SIM_GPS1_GLTCH_X": 0.0,  # degrees of latitude
    "SIM_GPS1_GLTCH_Y": 0.0,  # degrees of longitude
    "SIM_WIND_SPD": 0.0,
    "SIM_WIND_DIR": 180.0,  # where it comes from
}

ARDUPILOT = {
    "AHRS_EKF_TYPE": 3,
    "ARMING_CHECK": 1,
    "EK3_ENABLE": 1,
    **{f"EK3_SRC{number}_POSXY": 3 if number == 1 else 0 for number in (1, 2, 3)},
    **{f"EK3_SRC{number}_VELXY": 3 if number == 1 else 0 for number in (1, 2, 3)},
    **{f"EK3_SRC{number}_POSZ": 1 for number in (1, 2, 3)},
    **{f"EK3_SRC{number}_VELZ": 3 if number == 1 else 0 for number in (1, 2, 3)},
    **{f"EK3_SRC{number}_YAW": 1 if number == 1 else 0 for number in (1, 2, 3)},
    "FLOW_TYPE": 0,
    "GPS1_TYPE": 1,
    "GPS2_TYPE": 0,
    "GPS_AUTO_SWITCH": 1,
    "SERIAL1_BAUD": 57,
    "SERIAL1_PROTOCOL": 2,
    "SERIAL2_BAUD": 57,
    "SERIAL2_PROTOCOL": 2,
    "VISO_QUAL_MIN": 0,
    "VISO_TYPE": 0,
}
ARDUPILOT_KINDS = {
    "copter": {"FS_EKF_ACTION": 1, "FS_EKF_THRESH": 0.8},
    "plane": {"ARSPD_TYPE": 2, "ARSPD_USE": 1, "FS_LONG_ACTN": 0, "FS_SHORT_ACTN": 3, "TKOFF_ALT": 50.0},
    "rover": {"FS_EKF_ACTION": 1, "FS_EKF_THRESH": 0.8},
}

PX4 = {
    "EKF2_AGP0_ID": 1,
    "EKF2_AGP0_CTRL": 1,
    "EKF2_AGP0_DELAY": 0.0,
    "EKF2_AGP0_GATE": 3.0,
    "EKF2_AGP0_NOISE": 1.0,
    "EKF2_EV_CTRL": 0,
    "EKF2_GPS_CTRL": 7,
    "EKF2_NOAID_TOUT": 5_000_000,
    "EKF2_OF_CTRL": 0,
    "MAV_1_CONFIG": 102,
    "MAV_1_MODE": 2,
    "SER_TEL2_BAUD": 921_600,
    "SYS_HAS_GPS": 1,
}
