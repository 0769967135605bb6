"""The calibration of a map, stored in the map as text: the confidence models adapted to it (see `mapmaking.calibrate`),
the expected recognition rates, and the places that look alike."""

import json
import logging
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.errors import MapError
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.confidence import Model, parse_model
from edgevpr.runtime.recognise.evidence import MAP_FIGURES, PLACE_FIGURES, LookAlike, LookAlikes

MIN_PLACES = 30  # a map with fewer keeps the default models, and looking down it is not calibrated
_MIN_CONFIDENCE = 0.5  # mean confidence below which a place is hard to recognise
_CHECKSUM_DIGITS = 8

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapCalibration:
    """Calibration of a map: the result of querying it with `asked` altered images of its own places. `models` maps
    kinds of evidence to the models adapted to the map, none in a map of fewer than MIN_PLACES; `made` is the date. At
    the `precision` for which the map was calibrated, the fraction `accepted` of the images is accepted.
    `accepted_wrong` of these matches are wrong, including queries of places that were left out of the map for the test.
    `recognisable` maps the number of each tested place to the mean confidence (0..1) of its correct matches.
    `look_alikes`: None for a camera looking down."""

    models: Mapping[str, Model]
    made: str
    asked: int
    precision: float
    accepted: float
    accepted_wrong: int
    recognisable: Mapping[int, float] = field(default_factory=dict)
    look_alikes: LookAlikes | None = None

    @property
    def hardly_recognisable(self) -> float:
        """Fraction of the tested places that are hard to recognise."""
        return sum(mean < _MIN_CONFIDENCE for mean in self.recognisable.values()) / max(len(self.recognisable), 1)

    @property
    def looks_alike(self) -> bool:
        """True if more than half of the tested places are hard to recognise."""
        return self.hardly_recognisable > 0.5

    def figures(self) -> dict[str, Any]:
        """Return the figures as a dict for JSON."""
        names = ("made", "asked", "precision", "accepted_wrong", "looks_alike")
        return {name: getattr(self, name) for name in names} | {
            "made_of": [model.made_of for model in self.models.values()],
            "places_asked": len(self.recognisable),
            "accepted": round(self.accepted, 4),
            "hardly_recognisable": round(self.hardly_recognisable, 4),
            "twins": self.look_alikes.twins if self.look_alikes else None,
        }

    def describe(self) -> str:
        """Describe the calibration in one sentence: accepted and wrong matches, and places hard to recognise."""
        wrong = f"{self.accepted_wrong or 'no'} wrong match{'es were' if self.accepted_wrong > 1 else ' was'} accepted"
        warning = "; most of this map looks alike: expect few fixes over it" if self.looks_alike else ""
        if not self.models:
            warning += f"; fewer than {MIN_PLACES} places: the default confidence model is used"
        return (
            f"of {self.asked} altered copies of its own images {100 * self.accepted:.0f} % were accepted, at a "
            f"precision of {100 * self.precision:.6g} %; {wrong}; {100 * self.hardly_recognisable:.0f} % of "
            f"{len(self.recognisable)} places are hard to recognise{warning}"
        )


def require_usable(kind: str, model: Model) -> None:
    """Check a model read from a map. Raises ValueError for an unknown kind or name of evidence, which another version
    of edgevpr may use, and ValueError or ArithmeticError for figures that result in no confidence."""
    known = MAP_FIGURES.get(kind, ()) + PLACE_FIGURES.get(kind, ())
    if unknown := {*model.of_map.names, *model.of_place.names}.difference(known):
        raise ValueError(f"unknown evidence {min(unknown)!r:.40} for kind {kind!r:.40}")
    for value in (-1.0, 0.0, 1.0):
        model.confidence(dict.fromkeys(known, value))
    model.threshold(0.999999)


def read_calibration_for(place_map: PlaceMap) -> MapCalibration | None:
    """Return the calibration of a map; None if it has none or, with a warning in the log, if it is unusable."""
    try:
        text = place_map.calibration
        if text is None:
            return None
        calibration = read_calibration(text)
        for kind, model in calibration.models.items():
            require_usable(kind, model)
    except (ValueError, ArithmeticError, KeyError, TypeError, AttributeError, MapError) as error:
        _log.warning(
            "%s: its calibration is unusable (%s); the default confidence model is used: run `edgevpr map calibrate`",
            place_map.path,
            error,
        )
        return None
    return calibration


def explain_not_calibrated(spec: TechniqueSpec, places: int) -> str:
    """Return a sentence that explains why a map made with `spec`, with this number of places, is not calibrated."""
    if spec.looks_down and places < MIN_PLACES:
        return f"not calibrated ({places} places, fewer than {MIN_PLACES}): the default confidence model is used"
    return "not calibrated: the default confidence model is used; `edgevpr map calibrate` adapts it to the map"


def format_calibration(calibration: MapCalibration) -> str:
    """Format a calibration as text for `read_calibration`: the CRC-32 of the JSON, then the JSON."""
    body = json.dumps(asdict(calibration))
    return _checksum(body) + body


def read_calibration(text: str) -> MapCalibration:
    """Read a calibration from the text in a map. Raises ValueError if it is damaged, KeyError, TypeError or
    AttributeError if another version wrote it in another format."""
    body = text[_CHECKSUM_DIGITS:]
    if text != _checksum(body) + body:
        raise ValueError("its checksum is wrong")
    fields = json.loads(body)
    fields["models"] = {kind: parse_model(model) for kind, model in fields["models"].items()}
    fields["recognisable"] = {int(place_id): mean for place_id, mean in fields["recognisable"].items()}
    if (look_alikes := fields.get("look_alikes")) is not None:
        places = {int(place_id): LookAlike(**look_alike) for place_id, look_alike in look_alikes["places"].items()}
        fields["look_alikes"] = LookAlikes(bool(look_alikes["overlap"]), places)
    return MapCalibration(**fields)


def _checksum(body: str) -> str:
    return f"{zlib.crc32(body.encode('utf-8', 'surrogatepass')):0{_CHECKSUM_DIGITS}x}"
