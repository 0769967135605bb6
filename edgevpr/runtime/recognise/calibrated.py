"""The calibration that a map brings, as far as it makes sense; else the shipped models of confidence are used."""

import logging

from edgevpr.core.errors import MapError
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.evidence import require_usable
from edgevpr.runtime.recognise.stored_confidence import Calibration, from_text

_log = logging.getLogger(__name__)


def calibration_of(place_map: PlaceMap) -> Calibration | None:
    """Return the calibration of a map; None where it has none, and, with a warning, where it cannot be used."""
    try:
        text = place_map.calibration
        if text is None:
            return None
        found = from_text(text)
        for kind, model in found.models.items():
            require_usable(kind, model)
    except (ValueError, ArithmeticError, MapError) as error:
        _log.warning(
            "%s: its calibration cannot be used (%s): the shipped one is used; `edgevpr map calibrate` makes it anew",
            place_map.path,
            error,
        )
        return None
    return found
