"""Observers of a flight's events that report rotated or mirrored images."""

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

# Consecutive accepted matches that must show the rotation, and the smallest rotation to report. With this length of
# their mean direction they agree within about ten degrees. A compass is rarely that far off; cameras are by 90 or 180.
_TURN_MATCHES = 10
_MIN_TURN_DEG = 20.0
_MIN_MEAN_LENGTH = 0.97
_MISSES_TO_TRY = 15  # queries without a match before a mirrored image is tried; ten are common over featureless ground
_MISSES_TO_TRY_AGAIN = 30
_MAX_TRIES = 8  # each costs two queries
_MIRRORED_TO_REPORT = 2  # consecutive matching tries: a single one may be wrong


class TurnWatch:
    """Reports once if images are rotated relative to the autopilot's heading: they are then levelled about the wrong
    axes, and the heading prevents matches. Either `source.up_deg` or the compass is wrong."""

    def __init__(self, notifier: Notifier, source: SourceConfig) -> None:
        self._notifier, self._up_deg, self._has_reported = notifier, source.up_deg, False
        self._turns: deque[complex] = deque(maxlen=_TURN_MATCHES)  # each of length 1

    def update(self, event: Recognition) -> None:
        """Process the rotation between the match of an event and the reported heading."""
        located, view = event.located, event.view
        if self._has_reported or located is None or located.heading_deg is None or view.up_deg is None or view.reason:
            return
        self._turns.append(cmath.rect(1.0, math.radians(located.heading_deg - view.up_deg)))
        mean = sum(self._turns) / _TURN_MATCHES
        turn_deg = math.degrees(cmath.phase(mean))
        if len(self._turns) < _TURN_MATCHES or abs(mean) < _MIN_MEAN_LENGTH or abs(turn_deg) < _MIN_TURN_DEG:
            return
        self._has_reported, up_deg = True, (self._up_deg + turn_deg) % 360
        note = Reason(ReasonCode.IMAGES_ROTATED, {"rotation_deg": turn_deg, "up_deg": up_deg})
        gcs_text = f"images rotated {turn_deg:.0f} degrees"
        self._notifier.report("camera", Severity.WARNING, note, gcs_text=gcs_text, topic="turn")


class MirrorWatch:
    """Reports once if images are mirrored, for example by a camera setting: they never match. After many consecutive
    queries without a match, and no earlier match, an image is tried flipped left to right, and top to bottom."""

    def __init__(self, notifier: Notifier, recogniser: Recogniser) -> None:
        self._notifier, self._recogniser = notifier, recogniser
        self._meter = QueryMeter(recogniser.meter.board)  # separate, because the flight's meter may be recorded
        self._misses = self._tries = self._matches = 0
        self._next_try = _MISSES_TO_TRY

    def update(self, event: Recognition) -> None:
        """Count a query without a match, and try its image mirrored if enough have been counted."""
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
            self._notifier.report("camera", Severity.WARNING, Reason(ReasonCode.IMAGES_MIRRORED), topic="mirror")

    def _matches_mirrored(self, event: Recognition, axis: int) -> bool:
        """Return True if the mirrored image matches anywhere in the map, without the state of the flight."""
        assert event.frame is not None
        base, settings = self._recogniser, MatchSettings(candidates=self._recogniser.candidates)
        fresh = Recogniser(base.encoder, base.place_map, Matcher(base.index, base.rule), self._meter, settings=settings)
        frame = replace(event.frame, image=np.flip(event.frame.image, axis).copy())
        return fresh.step(frame, event.vehicle).accepted
