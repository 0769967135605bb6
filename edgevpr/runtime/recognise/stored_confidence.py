"""The calibration of a map: how sure it can be, in words and as the text that its file keeps."""

import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from edgevpr.runtime.recognise.confidence import Model, model_of

FEWEST_PLACES = 30  # with fewer the shipped model is used as it is
_HARDLY = 0.5  # mean confidence of a place that is hardly recognisable
_CHECKSUM_DIGITS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Calibration of a map, from `asked` changed pictures of its own places. `models` are those of its kinds of
    evidence. Of the pictures the share `accepted` is accepted at the precision that was asked for then, and
    `accepted_wrong` of all accepted matches are wrong, those of places that were left out among them. `recognisable`
    is the mean confidence of the right matches of a place, 0..1 by its number, of the places that were asked for."""

    models: Mapping[str, Model]
    made: str
    asked: int
    precision: float
    accepted: float
    accepted_wrong: int
    recognisable: Mapping[int, float] = field(default_factory=dict)

    @property
    def hardly_recognisable(self) -> float:
        """Share of the places asked for that are hardly recognisable."""
        return sum(each < _HARDLY for each in self.recognisable.values()) / max(len(self.recognisable), 1)

    @property
    def looks_alike(self) -> bool:
        """True where most of the map looks alike."""
        return self.hardly_recognisable > 0.5

    def figures(self) -> dict[str, Any]:
        """Return the figures for programs."""
        return {
            "made": self.made,
            "made_of": [model.made_of for model in self.models.values()],
            "asked": self.asked,
            "places_asked": len(self.recognisable),
            "precision": self.precision,
            "accepted": round(self.accepted, 4),
            "accepted_wrong": self.accepted_wrong,
            "hardly_recognisable": round(self.hardly_recognisable, 4),
            "looks_alike": self.looks_alike,
        }

    def said(self) -> str:
        """Say in words what to expect of the map."""
        wrong = {0: "no wrong match was", 1: "1 wrong match was"}.get(
            self.accepted_wrong, f"{self.accepted_wrong} wrong matches were"
        )
        alike = "; most of this map looks alike: expect few fixes over it" if self.looks_alike else ""
        return (
            f"of {self.asked} changed pictures of its own places {100 * self.accepted:.0f} % were accepted, at a "
            f"precision of {100 * self.precision:.6g} %, and {wrong}; {100 * self.hardly_recognisable:.0f} % of "
            f"{len(self.recognisable)} places are hardly recognisable{alike}"
        )


def not_calibrated(places: int) -> str:
    """Say of a map with so many places that it is not calibrated, and why."""
    if places < FEWEST_PLACES:
        return f"not calibrated ({places} places: fewer than {FEWEST_PLACES}): the shipped confidence is used"
    return "not calibrated: the shipped confidence is used; `edgevpr map calibrate` makes its own of its pictures"


def as_text(calibration: Calibration) -> str:
    """Write a calibration as `from_text` reads it: JSON, after the CRC-32 of it."""
    body = json.dumps(asdict(calibration))
    return _checksum(body) + body


def from_text(text: str) -> Calibration:
    """Read the text of a map. Raises ValueError for one that is damaged or makes no sense."""
    checksum, body = text[:_CHECKSUM_DIGITS], text[_CHECKSUM_DIGITS:]
    if checksum != _checksum(body):
        raise ValueError("its checksum is wrong")
    try:
        found = json.loads(body)
        recognisable = {int(place_id): float(each) for place_id, each in found["recognisable"].items()}
        calibration = Calibration(
            models={str(kind): model_of(each) for kind, each in found["models"].items()},
            made=str(found["made"]),
            asked=int(found["asked"]),
            precision=float(found["precision"]),
            accepted=float(found["accepted"]),
            accepted_wrong=int(found["accepted_wrong"]),
            recognisable=recognisable,
        )
    except (KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise ValueError(f"no calibration ({error!r:.80})") from error
    shares = (calibration.precision, calibration.accepted, *recognisable.values())
    if not all(math.isfinite(each) and 0 <= each <= 1 for each in shares):
        raise ValueError("a share is not within 0 and 1")
    return calibration


def _checksum(body: str) -> str:
    return f"{zlib.crc32(body.encode('utf-8', 'surrogatepass')):0{_CHECKSUM_DIGITS}x}"
