"""Learning in flight: a frame of what the map does not know becomes a place of it, where the autopilot says we are.

A wrong place would be believed by every later flight, so a frame is rather left out: where the position is not fresh,
where it may be an echo of our own fixes, where the picture says little, and where the map file has a place already.
"""

import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from edgevpr.config import Config
from edgevpr.errors import MapError, UsageError
from edgevpr.frames.exif import read_exif
from edgevpr.frames.images import list_images
from edgevpr.frames.positions import find_positions
from edgevpr.places.growing import GrowingIndex
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.types import Descriptor, Frame, Place, PlaceMatch, Position, Vehicle

POSITION_FRESH_S = 1.0
_ECHO_S = 10.0  # for so long after a fix of ours, the autopilot's position may be what we told it
_NEW_FOR_S = 30.0
_QUALITY_MIN = 0.2


class Learner:
    """Adds places to an open map and to the index in RAM, in this order: what the index knows is safe on the disk.

    `learnt` counts them and `passed_over` the frames that were left out, by reason. At the first trouble with the file
    it stops for good, and `trouble` says why: the flight goes on with what is there.
    """

    def __init__(
        self, place_map: PlaceMap, growing: GrowingIndex, spacing_m: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.learnt = 0
        self.passed_over: Counter[str] = Counter()
        self.trouble: str | None = None
        self._map, self._growing, self._spacing_m, self._clock = place_map, growing, spacing_m, clock
        self._new: deque[tuple[int, float]] = deque()

    @property
    def index(self) -> PlaceIndex:
        """What is recognised from now on, until the next `learn`."""
        return self._growing.index

    @property
    def summary(self) -> str:
        """How it goes, in a few words."""
        if self.trouble:
            return f"{self.learnt} places learnt, then stopped ({self.trouble})"
        left_out = ", ".join(f"{count} {reason}" for reason, count in self.passed_over.most_common())
        return f"{self.learnt} places learnt" + (f" (left out: {left_out})" if left_out else "")

    @property
    def totals(self) -> dict[str, Any]:
        """The same for the flight log."""
        return {"places": self.learnt, "left_out": dict(self.passed_over), "stopped": self.trouble}

    def learn(
        self, frame: Frame, descriptor: Descriptor, vehicle: Vehicle | None, t_fix_s: float | None
    ) -> Place | None:
        """Make a place of the frame and give it, or None where it is not worth one; never raises MapError.

        `vehicle` is what the autopilot said when the frame was taken, `t_fix_s` when a fix was last sent to it.
        """
        if self.trouble is not None:
            return None
        place = None
        try:
            here, objection = self._placed(frame, vehicle, t_fix_s)
            objection = objection or self._objection(here.position, descriptor.quality)
            if objection:
                self.passed_over[objection] += 1
                return None
            place_id = self._map.add(here, descriptor)
            self.learnt += 1
            self._new.append((place_id, self._clock()))
            place = Place(
                place_id=place_id,
                source_image=here.name,
                position=here.position,
                t_utc_s=here.t_utc_s,
                heading_deg=here.heading_deg,
                quality=descriptor.quality,
            )
            self._growing.add(place_id, here.position, descriptor.coarse, here.heading_deg)
        except MapError as error:
            self.trouble = str(error)
        return place

    def unless_new(self, event: PlaceMatch) -> PlaceMatch:
        """The event, not accepted where its place was learnt a moment ago: it says where the autopilot has just said
        that we are, so a fix would bring it nothing, and make its errors look confirmed."""
        while self._new and self._clock() - self._new[0][1] > _NEW_FOR_S:
            self._new.popleft()
        if not event.accepted or all(place_id != event.candidate.place.place_id for place_id, _ in self._new):
            return event
        reason = f"this place was learnt within the last {_NEW_FOR_S:g} s and says nothing new"
        return replace(event, accepted=False, reason=reason, position=None, accuracy_m=None)

    def _placed(self, frame: Frame, vehicle: Vehicle | None, t_fix_s: float | None) -> tuple[Frame, str | None]:
        """The frame where it was taken, and what is to be said against learning it there."""
        if frame.position:  # a recording's own: no echo of anything
            return frame, None
        if vehicle is None or abs(vehicle.t_heard_s - frame.t_mono_s) > POSITION_FRESH_S:
            return frame, "without a fresh position"
        if not vehicle.has_gps:  # it reckons, and goes on saying so
            return frame, "without GPS"
        if t_fix_s is not None and self._clock() - t_fix_s < _ECHO_S:
            return frame, "just after a fix"
        position = Position(vehicle.lat_deg, vehicle.lon_deg, vehicle.alt_m)
        return replace(frame, position=position, heading_deg=vehicle.heading_deg, t_utc_s=time.time()), None

    def _objection(self, position: Position, quality: float) -> str | None:
        if not quality >= _QUALITY_MIN:  # so written, NaN is refused as well
            return "of low quality"
        # The file is asked, not the index: a place that was given up in RAM is not to be learnt again.
        if self._map.nearest_m(position, self._spacing_m) is not None:
            return "near a place"
        return None


def check_positions(config: Config, positions: Path | None) -> None:
    """Raise UsageError where nothing could ever say where a frame was taken: no link, and no recording that knows."""
    folder = Path(config.source.uri)
    if config.mavlink.link is None and not (folder.is_dir() and (positions or _has_positions(folder))):
        raise UsageError(
            "There is nothing to learn positions from: name the flight controller with --link, or a folder of images "
            "with positions (--positions, or EXIF)."
        )


def _has_positions(folder: Path) -> bool:
    return bool(find_positions(folder)) or any(read_exif(path).position for path in list_images(folder))
