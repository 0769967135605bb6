"""Observers of a flight's events that report turned or mirrored pictures."""

import cmath
import math
from collections import deque
from dataclasses import replace

import numpy as np

from edgevpr.core.config import SourceConfig
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.messages import Severity
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.flight.notifier import Notifier
from edgevpr.runtime.recognise.decide import Matcher, MatchSettings
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition

# Accepted matches in a row by which pictures are turned, and the least turn; with this length of the mean of their
# directions they agree to some ten degrees. A compass is rarely wrong by so much, a camera is by 90 or 180.
_TURN_MATCHES = 10
_MIN_TURN_DEG = 20.0
_MIN_MEAN_LENGTH = 0.97
_MISSES_TO_TRY = 15  # queries without a match before a mirrored picture is tried; over poor ground ten are usual
_MISSES_TO_TRY_AGAIN = 30
_MAX_TRIES = 8  # each costs two queries
_MIRRORED_TO_REPORT = 2  # tries in a row that match: one may be wrong


class TurnWatch:
    """Reports once if pictures are turned against the autopilot's heading: they are then levelled along wrong axes, and
    the heading keeps matches from being found. Either `source.up_deg` is wrong, or the compass."""

    def __init__(self, notifier: Notifier, source: SourceConfig) -> None:
        self._notifier, self._up_deg, self._has_reported = notifier, source.up_deg, False
        self._turns: deque[complex] = deque(maxlen=_TURN_MATCHES)  # each of length 1

    def update(self, event: Recognition) -> None:
        """Take the direction that the match of an event shows."""
        where, view_up_deg = event.located, event.view.up_deg
        if self._has_reported or where is None or where.heading_deg is None or view_up_deg is None or event.view.reason:
            return
        self._turns.append(cmath.rect(1.0, math.radians(where.heading_deg - view_up_deg)))
        mean = sum(self._turns) / _TURN_MATCHES
        turn_deg = math.degrees(cmath.phase(mean))
        if len(self._turns) < _TURN_MATCHES or abs(mean) < _MIN_MEAN_LENGTH or abs(turn_deg) < _MIN_TURN_DEG:
            return
        self._has_reported, up_deg = True, (self._up_deg + turn_deg) % 360
        note = Reason(ReasonCode.PICTURES_TURNED, {"turn_deg": turn_deg, "up_deg": up_deg})
        ground = f"pictures turned {turn_deg:.0f} degrees"
        self._notifier.report("camera", Severity.WARNING, note, ground=ground, topic="turn")


class MirrorWatch:
    """Reports once if pictures are mirrored, as by a setting of the camera: they never match. Where many queries in a
    row have no match, and none had one before, a picture is tried flipped left to right, and top to bottom."""

    def __init__(self, notifier: Notifier, recogniser: Recogniser) -> None:
        self._notifier, self._recogniser = notifier, recogniser
        self._meter = QueryMeter(recogniser.meter.board)  # its own: that of the flight may be recorded
        self._misses = self._tries = self._matches = 0
        self._next_try = _MISSES_TO_TRY

    def update(self, event: Recognition) -> None:
        """Count a query without a match, and try its picture mirrored if it is time to."""
        if event.accepted:
            self._tries = _MAX_TRIES
        has_ground = event.is_query and not (event.failed or event.lacks_texture or event.view.reason)
        if self._tries == _MAX_TRIES or event.frame is None or not has_ground:
            return
        self._misses += 1
        if self._misses < self._next_try:
            return
        is_mirrored = self._matches_mirrored(event, 1) or self._matches_mirrored(event, 0)
        self._tries += 1
        self._matches = self._matches + 1 if is_mirrored else 0
        self._next_try = self._misses + (1 if is_mirrored else _MISSES_TO_TRY_AGAIN)
        if self._matches == _MIRRORED_TO_REPORT:
            self._tries = _MAX_TRIES
            note = Reason(ReasonCode.PICTURES_MIRRORED)
            self._notifier.report("camera", Severity.WARNING, note, topic="mirror")

    def _matches_mirrored(self, event: Recognition, axis: int) -> bool:
        """Search the whole map for the flipped picture, by nothing that the flight knows."""
        assert event.frame is not None
        now, settings = self._recogniser, MatchSettings(candidates=self._recogniser.candidates)
        alone = Recogniser(now.encoder, now.place_map, Matcher(now.index, now.rule), self._meter, settings=settings)
        frame = replace(event.frame, image=np.flip(event.frame.image, axis).copy())
        return alone.step(frame, event.vehicle).accepted
