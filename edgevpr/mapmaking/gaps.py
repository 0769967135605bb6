"""Gaps in a map: where no frame is memorable for long, the best of them are kept all the same (thesis 3.4.8).

A frame that does not pass waits. When there would be no place for `most_frames` frames, or for `most_m` metres of the
way, all thresholds are lowered in steps of 0.03 until some of those that wait pass; these become places of low quality.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Position, Salience
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.runtime.recognise.salience_gate import GAP_FRAMES, best_of

_NO_PIXELS = np.empty((0, 0), np.uint8)
Kept = tuple[Recognition, Salience | None]


class Gaps:
    """Takes one event after the other, and gives back those that become places, in their order."""

    def __init__(self, most_frames: int = GAP_FRAMES, most_m: float | None = None) -> None:
        self._most_frames, self._most_m = most_frames, most_m
        self._waiting: list[Recognition] = []
        self._last: Position | None = None  # of the last place; before there is one, of the first frame
        self._has_begun = False

    def take(self, event: Recognition) -> Iterator[Kept]:
        """Yield what becomes a place now that the frame of `event` is seen."""
        if event.worth is None:
            yield event, None
            return
        while self._waiting and (len(self._waiting) >= self._most_frames or self._is_too_far(event.frame.position)):
            yield from self._best_waiting()
        if event.worth.reason is None:
            self._waiting.clear()
            yield self._kept(event), event.worth.salience
        else:
            self._last = self._last or event.frame.position
            self._waiting.append(replace(event, frame=replace(event.frame, image=_NO_PIXELS)))

    def end(self) -> Iterator[Kept]:
        """Yield what becomes a place at the end: of a recording in which nothing has passed, the best of it."""
        if not self._has_begun and self._waiting:
            yield from self._best_waiting()

    def _best_waiting(self) -> Iterator[Kept]:
        """Yield the best of those that wait; those after the last of them wait on."""
        best = best_of([event.worth.short_by for event in self._waiting])
        last = max(number for number, is_best in enumerate(best) if is_best)
        chosen = [event for event, is_best in zip(self._waiting, best, strict=True) if is_best]
        self._waiting = self._waiting[last + 1 :]
        for event in chosen:
            yield self._kept(event), replace(event.worth.salience, is_low=True)

    def _kept(self, event: Recognition) -> Recognition:
        self._has_begun, self._last = True, event.frame.position or self._last
        return event

    def _is_too_far(self, position: Position | None) -> bool:
        if self._most_m is None or position is None or self._last is None:
            return False
        return distance_m(self._last.lat_deg, self._last.lon_deg, position.lat_deg, position.lon_deg) > self._most_m
