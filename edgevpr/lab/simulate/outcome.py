"""Answers of the runtime in a generated flight, compared with the truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Position
from edgevpr.frames.positions import find_positions, read_positions
from edgevpr.runtime.flight.wholeflight import flight_of

# A place is the right one where the two pictures share 30 % of their ground, which is 78 m long from a height of 80 m.
RIGHT_M = 55.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """One query: where it was taken, the place that was named, and whether the runtime accepted it. `error_m` is the
    distance between the two, `nearest_m` that to the nearest place of the map, and `fix_off_m` that to the fix (None:
    not accepted)."""

    query: str
    reference_image: str
    at: Position
    named: Position
    score: float
    accepted: bool
    error_m: float
    nearest_m: float
    fix_off_m: float | None

    @property
    def right(self) -> bool:
        return self.error_m <= RIGHT_M

    @property
    def on_map(self) -> bool:
        """True where the map has a right place for the query."""
        return self.nearest_m <= RIGHT_M


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Counts, shares and errors of a flight. `recall_at_1` is of the queries on the map. The errors are metres from the
    point where a picture was taken to the fix, of the accepted queries (NaN without any)."""

    queries: int
    on_map: int
    recall_at_1: float
    accepted: int
    accepted_wrong: int
    off_map_rejected: int
    error_median_m: float
    error_p90_m: float
    error_max_m: float


def read_answers(log_path: Path, map_images: Path, query_images: Path) -> list[Answer]:
    """Read the queries of a flight log, and judge them by the positions.csv of the two flights."""
    places = {name: tag.position for name, tag in read_positions(find_positions(map_images)).items()}
    taken = {name: tag.position for name, tag in read_positions(find_positions(query_images)).items()}
    lat_deg, lon_deg = np.array([(place.lat_deg, place.lon_deg) for place in places.values()]).T
    answers = []
    for line in flight_of(log_path):
        if line["kind"] == "query":
            at, named = taken[line["query"]], places[line["reference_image"]]
            error_m = distance_m(at.lat_deg, at.lon_deg, named.lat_deg, named.lon_deg)
            nearest_m = distance_m(at.lat_deg, at.lon_deg, lat_deg, lon_deg).min()
            answers.append(
                Answer(
                    query=line["query"],
                    reference_image=line["reference_image"],
                    at=at,
                    named=named,
                    score=line["score"],
                    accepted=line["accepted"],
                    error_m=float(error_m),
                    fix_off_m=_off_m(line["located"], at) if line["accepted"] else None,
                    nearest_m=float(nearest_m),
                )
            )
    return answers


def _off_m(located: dict[str, Any], at: Position) -> float:
    return float(distance_m(at.lat_deg, at.lon_deg, located["lat_deg"], located["lon_deg"]))


def outcome(answers: Sequence[Answer]) -> Outcome:
    """Sum up the answers of a flight."""
    on_map = [answer for answer in answers if answer.on_map]
    accepted = [answer for answer in answers if answer.accepted]
    errors_m = [answer.fix_off_m for answer in accepted] or [np.nan]
    return Outcome(
        queries=len(answers),
        on_map=len(on_map),
        recall_at_1=sum(answer.right for answer in on_map) / max(len(on_map), 1),
        accepted=len(accepted),
        accepted_wrong=sum(not answer.right for answer in accepted),
        off_map_rejected=sum(not answer.on_map and not answer.accepted for answer in answers),
        error_median_m=float(np.median(errors_m)),
        error_p90_m=float(np.quantile(errors_m, 0.9)),
        error_max_m=float(np.max(errors_m)),
    )
