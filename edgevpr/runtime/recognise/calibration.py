"""The calibration of a map, which is stored in it as text: the models of confidence that were adapted to it (see
`mapmaking.calibrate`), what to expect of it, and which of its places look alike."""

import json
import logging
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from edgevpr.core.errors import MapError
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.confidence import Model, parse_model
from edgevpr.runtime.recognise.evidence import MAP_FIGURES, PLACE_FIGURES, LookAlike, LookAlikes

MIN_PLACES = 30  # a map with fewer is not calibrated
_MIN_CONFIDENCE = 0.5  # mean confidence below which a place is hardly recognisable
_CHECKSUM_DIGITS = 8

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapCalibration:
    """Calibration of a map: the result of looking for a number (`asked`) of altered pictures of its own places.
    `models` maps kinds of evidence to the models adapted to the map, and `made` is the date. At the `precision` that
    the calibration was made for, the share `accepted` of the pictures is accepted. `accepted_wrong` of the accepted
    matches are wrong, among them those of places that were left out of the map for the test. `recognisable` maps the
    number of each place tested to the mean confidence (0..1) of its right matches. `look_alikes`: None looking down."""

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
        """Share of the tested places that are hardly recognisable."""
        return sum(each < _MIN_CONFIDENCE for each in self.recognisable.values()) / max(len(self.recognisable), 1)

    @property
    def looks_alike(self) -> bool:
        """True if more than half of the tested places are hardly recognisable."""
        return self.hardly_recognisable > 0.5

    def figures(self) -> dict[str, Any]:
        """Return the figures as a dict for JSON."""
        kept = ("made", "asked", "precision", "accepted_wrong", "looks_alike")
        return {name: getattr(self, name) for name in kept} | {
            "made_of": [model.made_of for model in self.models.values()],
            "places_asked": len(self.recognisable),
            "accepted": round(self.accepted, 4),
            "hardly_recognisable": round(self.hardly_recognisable, 4),
            "twins": self.look_alikes.twins if self.look_alikes else None,
        }

    def described(self) -> str:
        """Describe the calibration in one sentence: matches accepted, wrong matches, and hardly recognisable places."""
        wrong = f"{self.accepted_wrong or 'no'} wrong match{'es were' if self.accepted_wrong > 1 else ' was'} accepted"
        alike = "; most of this map looks alike: expect few fixes over it" if self.looks_alike else ""
        return (
            f"of {self.asked} altered copies of its own images {100 * self.accepted:.0f} % were accepted, at a "
            f"precision of {100 * self.precision:.6g} %; {wrong}; {100 * self.hardly_recognisable:.0f} % of "
            f"{len(self.recognisable)} places are hard to recognise{alike}"
        )


def require_usable(kind: str, model: Model) -> None:
    """Check a model read from a map. Raises ValueError for an unknown kind or name of evidence, as another version of
    edgevpr may have, and ValueError or ArithmeticError for figures with which no confidence can be computed."""
    known = MAP_FIGURES.get(kind, ()) + PLACE_FIGURES.get(kind, ())
    names = {name for each in (model.of_map, model.of_place) for name in each.names}
    if unknown := names.difference(known):
        raise ValueError(f"unknown evidence {min(unknown)!r:.40} for kind {kind!r:.40}")
    for value in (-1.0, 0.0, 1.0):
        model.confidence(dict.fromkeys(known, value))
    model.threshold(0.999999)


def read_calibration_for(place_map: PlaceMap) -> MapCalibration | None:
    """Return the calibration of a map; None if it has none, or, after a warning in the log, if it is unusable."""
    try:
        text = place_map.calibration
        if text is None:
            return None
        found = read_calibration(text)
        for kind, model in found.models.items():
            require_usable(kind, model)
    except (ValueError, ArithmeticError, KeyError, TypeError, AttributeError, MapError) as error:
        _log.warning(
            "%s: its calibration cannot be used (%s): the shipped one is used; `edgevpr map calibrate` makes it anew",
            place_map.path,
            error,
        )
        return None
    return found


def explain_not_calibrated(places: int) -> str:
    """Return a sentence for a map with so many places: it is not calibrated, and why."""
    if places < MIN_PLACES:
        return f"not calibrated ({places} places: fewer than {MIN_PLACES}): the shipped confidence is used"
    return "not calibrated: the shipped confidence is used; `edgevpr map calibrate` makes its own of its pictures"


def format_calibration(calibration: MapCalibration) -> str:
    """Write a calibration as text for `read_calibration`: the CRC-32 of the JSON that follows, then the JSON."""
    body = json.dumps(asdict(calibration))
    return _checksum(body) + body


def read_calibration(text: str) -> MapCalibration:
    """Read a calibration from the text in a map. Raises ValueError if it is damaged, KeyError, TypeError or
    AttributeError if another version has written it in another form."""
    body = text[_CHECKSUM_DIGITS:]
    if text != _checksum(body) + body:
        raise ValueError("its checksum is wrong")
    found = json.loads(body)
    found["models"] = {kind: parse_model(model) for kind, model in found["models"].items()}
    found["recognisable"] = {int(place_id): each for place_id, each in found["recognisable"].items()}
    if (alike := found.get("look_alikes")) is not None:
        places = {int(place_id): LookAlike(**each) for place_id, each in alike["places"].items()}
        found["look_alikes"] = LookAlikes(bool(alike["overlap"]), places)
    return MapCalibration(**found)


def _checksum(body: str) -> str:
    return f"{zlib.crc32(body.encode('utf-8', 'surrogatepass')):0{_CHECKSUM_DIGITS}x}"
