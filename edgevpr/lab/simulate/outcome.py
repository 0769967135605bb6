"""Answers of the runtime in a generated flight, compared with the truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Position
from edgevpr.frames.positions import find_positions, read_positions
from edgevpr.runtime.flight.wholeflight import flight_of

# A place is the right one where the two pictures share 30 % of their ground, which is 78 m long from a height of 80 m.
RIGHT_M = 55.0


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedAnswer:
    """One query: where it was taken, and the place that was named. `error_m` is the distance between the two,
    `nearest_m` that to the nearest place of the map, and `fix_off_m` that to the fix (None: not accepted)."""

    query: str
    reference_image: str
    at: Position
    named: Position
    score: float
    error_m: float
    nearest_m: float
    fix_off_m: float | None

    @property
    def accepted(self) -> bool:
        return self.fix_off_m is not None

    @property
    def right(self) -> bool:
        return self.error_m <= RIGHT_M

    @property
    def on_map(self) -> bool:
        """True where the map has a right place for the query."""
        return self.nearest_m <= RIGHT_M


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightOutcome:
    """Counts, shares and errors of a flight. `recall_at_1` is of the queries on the map. The errors are metres from the
    point where a picture was taken to the fix, of the accepted queries (NaN without any): median, 90 % and largest."""

    queries: int
    on_map: int
    recall_at_1: float
    accepted: int
    accepted_wrong: int
    off_map_rejected: int
    errors_m: tuple[float, float, float]


def read_answers(log_path: Path, map_images: Path, query_images: Path) -> list[JudgedAnswer]:
    """Read the queries of a flight log, and judge them by the positions.csv of the two flights."""
    places, taken = (_positions(images) for images in (map_images, query_images))
    answers = []
    for line in flight_of(log_path):
        if line["kind"] == "query":
            at, named, fix = taken[line["query"]], places[line["reference_image"]], line["located"]
            answers.append(
                JudgedAnswer(
                    query=line["query"],
                    reference_image=line["reference_image"],
                    at=at,
                    named=named,
                    score=line["score"],
                    error_m=_apart_m(at, named),
                    nearest_m=min(_apart_m(at, place) for place in places.values()),
                    fix_off_m=_apart_m(at, Position(fix["lat_deg"], fix["lon_deg"])) if line["accepted"] else None,
                )
            )
    return answers


def outcome(answers: Sequence[JudgedAnswer]) -> FlightOutcome:
    """Sum up the answers of a flight."""
    on_map = [answer for answer in answers if answer.on_map]
    accepted = [answer for answer in answers if answer.accepted]
    errors_m = [answer.fix_off_m for answer in accepted if answer.fix_off_m is not None] or [np.nan]
    return FlightOutcome(
        queries=len(answers),
        on_map=len(on_map),
        recall_at_1=sum(answer.right for answer in on_map) / max(len(on_map), 1),
        accepted=len(accepted),
        accepted_wrong=sum(not answer.right for answer in accepted),
        off_map_rejected=sum(not answer.on_map and not answer.accepted for answer in answers),
        errors_m=(float(np.median(errors_m)), float(np.quantile(errors_m, 0.9)), max(errors_m)),
    )


def _positions(images: Path) -> dict[str, Position]:
    table = find_positions(images)
    tags = read_positions(table) if table else {}
    return {name: tag.position for name, tag in tags.items() if tag.position}


def _apart_m(one: Position, other: Position) -> float:
    return float(distance_m(one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg))
