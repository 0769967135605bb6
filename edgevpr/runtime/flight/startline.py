"""The first line of a flight log: all that identifies a flight."""

import logging
import platform
import sys
from dataclasses import asdict
from typing import Any

from edgevpr import __version__
from edgevpr.core.config import Config
from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.errors import MapError
from edgevpr.places.identity import MapIdentity, identity_of
from edgevpr.places.mapfile import PlaceMap

_LIBRARIES = ("numpy", "cv2", "onnxruntime")

_log = logging.getLogger(__name__)


def start_fields(config: Config, board_name: str, spec: TechniqueSpec, place_map: PlaceMap) -> dict[str, Any]:
    """Return the fields of a flight's first line, of kind "start": all that a flight depends on, but for its pictures
    and its autopilot. Of the libraries those are named that are loaded."""
    loaded = {name: getattr(sys.modules.get(name), "__version__", None) for name in _LIBRARIES}
    return {
        "version": __version__,
        "technique": spec.name,
        "parameters": spec.parameters,
        "model_sha256": spec.model_sha256,
        "board": board_name,
        "machine": platform.machine(),
        "python": platform.python_version(),
        "libraries": {name: version for name, version in loaded.items() if version},
        "map": config.map,
        "map_identity": _identity(place_map),
        "config": asdict(config),
    }


def _identity(place_map: PlaceMap) -> MapIdentity | None:
    """Return the identity of a map, None for one without places: each of those is a new one."""
    try:
        found = identity_of(place_map)
        return found if found.places else None
    except MapError as error:  # the places that can be read are flown with
        _log.warning("the log does not say which map it is: %s", error)
        return None
