"""What a map says of how sure it can be, as the text that its file keeps."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from edgevpr.confidence.model import Model, model_of


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


def as_text(calibration: Calibration) -> str:
    return json.dumps(asdict(calibration))


def from_text(text: str) -> Calibration:
    """Read the text of a map. Raises ValueError for one that makes no sense."""
    try:
        found = json.loads(text)
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
