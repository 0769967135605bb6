"""Learning in flight: a frame of ground that the map lacks becomes a place at the position that the autopilot reports.

A wrong place would mislead every later flight, so a doubtful frame is left out: its position is not fresh or may only
repeat our own fixes, its quality is low, the map has a place near it, or the flight so far does not tell where it is.
"""

import math
import os
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from edgevpr.core.config import Config
from edgevpr.core.contract import Descriptor
from edgevpr.core.errors import MapBusyError, MapError, PlaceError, UsageError
from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Frame, Place, Position, Vehicle
from edgevpr.frames.level import View
from edgevpr.places.index import GrowingIndex
from edgevpr.places.retrieve import named
from edgevpr.runtime.recognise.levelling import GPS_SD_M, place_at_middle
from edgevpr.runtime.recognise.locate import MAX_PLACES_CHECKED, combine_with_recorded, locate
from edgevpr.runtime.recognise.place_filter import Followed
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition

# Seconds after a fix that the autopilot took, or perhaps took, in which its position may only repeat that fix. A fix
# that it refused does not count, nor does the fix of the frame itself: the position was reported before it.
_ECHO_S = 10.0
_QUALITY_MIN = 0.2
_SURE = 0.9  # least probability of being lost, or of being where the flight so far says
_CONTRADICTS_SD, _ROOM_M = 4.0, 20.0  # the position of a place may err by more than its covariance says


class _LeftOut(Exception):
    """Reason why a frame becomes no place."""


class Learner:
    """Adds places to an open map, then to the index in RAM: every place in the index is already safe on disk.

    `learnt` is the number of places added. `passed_over` counts the frames left out, by reason. A frame is left out
    while another program writes to the file, and while learning is turned off (`is_off`). At any other error of the
    file learning stops for good and `trouble` says why; the flight goes on with the places it has.
    """

    def __init__(
        self,
        recogniser: Recogniser,
        growing: GrowingIndex,
        *,
        spacing_m: float,
        gap_m: float,
        utc_clock: Callable[[], float] = time.time,
    ) -> None:
        self.learnt = 0
        self.passed_over: Counter[str] = Counter()
        self.trouble: str | None = None
        self.is_off = False
        self._recogniser, self._growing, self._spacing_m, self._gap_m = recogniser, growing, spacing_m, gap_m
        self._map, self._utc_clock = growing.place_map, utc_clock

    @property
    def summary(self) -> str:
        """Progress of learning, in a few words."""
        if self.trouble:
            return f"{self.learnt} places learnt, then stopped ({self.trouble})"
        left_out = ", ".join(f"{count} {reason}" for reason, count in self.passed_over.most_common())
        return f"{self.learnt} places learnt" + (f" (left out: {left_out})" if left_out else "")

    @property
    def totals(self) -> dict[str, Any]:
        """Numbers of places learnt and frames left out, and the error that stopped learning (None: none), as a dict."""
        return {"places": self.learnt, "left_out": dict(self.passed_over), "stopped": self.trouble}

    def learn(self, event: Recognition) -> Place | None:
        """Make a place of an event's frame. Return its number, picture, position and quality; None if the frame is left
        out. Never raises MapError."""
        frame, picture, seen = event.frame, event.picture, event.descriptor
        if self.trouble is not None or self.is_off or event.failed or not (frame and picture and seen):
            return None
        place = None
        try:
            here = place_at_middle(self._placed(frame, event.vehicle), event.view)
            self._require_worth(here.position, seen, event)
            here = self._tied(here, event)
            self._map.require_unchanged()  # a place written to a deleted file would be lost
            worth = event.worth
            salience = replace(worth.salience, is_low=worth.reason is not None) if worth else None
            place_id = self._map.add(here, seen, salience, self._recogniser.encoder.pack_landmarks(picture))
            self.learnt += 1
            place = Place(place_id=place_id, source_image=here.name, position=here.position, quality=seen.quality)
            self._growing.add(place_id, here.position, seen.coarse, here.heading_deg)
        except _LeftOut as reason:
            self.passed_over[str(reason)] += 1
        except MapBusyError:
            if place is None:
                self.passed_over["while another program was writing"] += 1
        except MapError as error:
            self.trouble = str(error)
        if place:
            self._recogniser.add_place(self._growing.index, place.place_id, frame.t_mono_s)
        return place

    def _placed(self, frame: Frame, vehicle: Vehicle | None) -> Frame:
        """Return the frame, with the position at which to learn it. Raises _LeftOut if it is not to be trusted."""
        if frame.position:  # it comes from the recording, so it does not repeat our fixes
            return frame
        if vehicle is None or not vehicle.is_fresh_at(frame.t_mono_s):
            raise _LeftOut("without a fresh position")
        if not vehicle.has_gps:  # without GPS the reported position is only an estimate
            raise _LeftOut("without GPS")
        if frame.t_mono_s - vehicle.t_fix_s < _ECHO_S:
            raise _LeftOut("just after a fix")
        position = Position(vehicle.lat_deg, vehicle.lon_deg, vehicle.alt_m)
        return replace(frame, position=position, heading_deg=vehicle.heading_deg, t_utc_s=self._utc_clock())

    def _require_worth(self, position: Position | None, seen: Descriptor, event: Recognition) -> None:
        """Raise _LeftOut if there is a reason against learning a place at this position."""
        if position is None:
            raise _LeftOut("without a position")
        if event.says_nothing or not seen.quality >= _QUALITY_MIN:  # `not >=` refuses NaN as well
            raise _LeftOut("of low quality")
        # Ask the file, not the index: a place that was dropped from RAM must not be learnt again.
        if self._growing.nearest_m(position) <= self._spacing_m:
            raise _LeftOut("near a place")
        _require_no_contradiction(event.followed, position)
        if event.worth and event.worth.reason and self._growing.nearest_m(position) <= self._gap_m:
            raise _LeftOut("not memorable")

    def _tied(self, frame: Frame, event: Recognition) -> Frame:
        """Correct the position of a frame by the places around it, if they agree with its recorded position."""
        recogniser = self._recogniser
        if frame.pose or frame.position is None or event.ranking is None or not recogniser.technique.spec.looks_down:
            return frame
        try:
            found = named(event.ranking, recogniser.index, self._map, first=MAX_PLACES_CHECKED)
        except PlaceError:  # the unreadable place is left out from now on; the frame can be learnt without it
            return frame
        if found[0].match.score < recogniser.technique.min_score:
            return frame
        where = locate(found, recogniser.technique.spec.cells, View(aside=(0.0, 0.0)))  # of the picture's middle
        learnt = where and not where.objection and combine_with_recorded(where, frame.position, GPS_SD_M)
        return replace(frame, position=learnt[0], pose=learnt[1]) if learnt else frame


def _require_no_contradiction(followed: Followed | None, position: Position) -> None:
    """Raise _LeftOut unless the flight so far says that the aircraft is very probably off the map, or at this place."""
    if followed is None or followed.estimate is None or followed.lost >= _SURE:
        return
    if followed.mass < _SURE:
        raise _LeftOut("while not sure where it is")
    here, there = position, followed.estimate.position
    away_m = float(distance_m(here.lat_deg, here.lon_deg, there.lat_deg, there.lon_deg))
    if away_m > _CONTRADICTS_SD * math.hypot(followed.estimate.sd_m, GPS_SD_M) + _ROOM_M:
        raise _LeftOut("where the flight so far contradicts it")


def check_positions(config: Config) -> None:
    """Raise UsageError if no frame can ever have a position: there is neither a link nor a folder of images."""
    if config.mavlink.link is None and not os.path.isdir(config.source.uri or ""):
        raise UsageError(
            "There is nothing to learn positions from: name the flight controller with --link, or a folder of images "
            "with positions (--positions, or EXIF)."
        )
