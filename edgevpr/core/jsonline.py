"""One JSON object a line, of values of any kind."""

import json
import math
from dataclasses import asdict, is_dataclass
from typing import Any

from edgevpr.core.text import without_passwords


def json_line(value: Any) -> bytes:
    """Write a value as one line of JSON, without passwords. Dataclasses become objects, NaN and infinities null."""
    text = json.dumps(_plain(value), ensure_ascii=False, allow_nan=False)
    # Text that is not UTF-8 (a foreign file name) becomes a \u escape, which JSON reads back unchanged.
    return text.encode("utf-8", "backslashreplace") + b"\n"


def _plain(value: Any) -> Any:
    """Return `value` in JSON's types."""
    if isinstance(value, str):
        return without_passwords(value)
    if value is None or isinstance(value, (bool, int)):
        return value
    if isinstance(value, float):
        return _readable(value)
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if is_dataclass(value):
        return _plain(asdict(value))
    if hasattr(value, "tolist"):  # NumPy's scalars and arrays
        return _plain(value.tolist())
    return without_passwords(str(value))


def _readable(value: float) -> float | None:
    """Round to seven decimals (a centimetre of latitude, and what MAVLink carries) or seven digits, whichever is
    more."""
    if not math.isfinite(value):
        return None
    return round(value, 7) if abs(value) >= 1 else float(f"{value:.7g}")
