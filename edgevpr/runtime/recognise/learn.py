"""Learning in flight: a frame of what the map does not know becomes a place of it, where the autopilot says we are.

A wrong place would be believed by every later flight, so a frame is rather left out: where the position is not fresh,
where it may be an echo of our own fixes, where the picture says little, and where the map file has a place already.
"""

import math
import time
from collections import Counter
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
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.types import Frame, Place, Position, Vehicle

_ECHO_S = 10.0  # for so long after a fix of ours, the autopilot's position may be what we told it
_QUALITY_MIN = 0.2


class Learner:
    """Adds places to an open map and to the index in RAM, in this order: what the index knows is safe on the disk.

    `learnt` counts them and `passed_over` the frames that were left out, by reason. At the first trouble with the file
    it stops for good, and `trouble` says why: the flight goes on with what is there.
    """

    def __init__(
        self,
        recogniser: Recogniser,
        growing: GrowingIndex,
        spacing_m: float,
        utc_clock: Callable[[], float] = time.time,
    ) -> None:
        self.learnt = 0
        self.passed_over: Counter[str] = Counter()
        self.trouble: str | None = None
        self._recogniser, self._growing, self._spacing_m = recogniser, growing, spacing_m
        self._map, self._utc_clock = recogniser.place_map, utc_clock
        self._t_fix_s = -math.inf

    @property
    def summary(self) -> str:
        """Say how it goes, in a few words."""
        if self.trouble:
            return f"{self.learnt} places learnt, then stopped ({self.trouble})"
        left_out = ", ".join(f"{count} {reason}" for reason, count in self.passed_over.most_common())
        return f"{self.learnt} places learnt" + (f" (left out: {left_out})" if left_out else "")

    @property
    def totals(self) -> dict[str, Any]:
        """Say the same for the flight log."""
        return {"places": self.learnt, "left_out": dict(self.passed_over), "stopped": self.trouble}

    def learn(self, event: Recognition) -> Place | None:
        """Make a place of the frame of an event and give it, or None where it is not worth one; never raises MapError.

        A fix that the event sent, or that waits to be sent, may come back as the autopilot's position from now on.
        """
        if event.fix and event.fix.sent is not False:
            self._t_fix_s = event.frame.t_mono_s
        if self.trouble is not None or event.failed:
            return None
        place = None
        try:
            here, objection = self._placed(event.frame, event.vehicle)
            objection = objection or self._objection(here.position, event.descriptor.quality)
            if objection:
                self.passed_over[objection] += 1
                return None
            place_id = self._map.add(here, event.descriptor)
            self.learnt += 1
            place = Place(
                place_id=place_id,
                source_image=here.name,
                position=here.position,
                t_utc_s=here.t_utc_s,
                heading_deg=here.heading_deg,
                quality=event.descriptor.quality,
            )
            self._growing.add(place_id, here.position, event.descriptor.coarse, here.heading_deg)
        except MapError as error:
            self.trouble = str(error)
        if place:
            self._recogniser.extend(self._growing.index, place.place_id, here.t_mono_s)
        return place

    def _placed(self, frame: Frame, vehicle: Vehicle | None) -> tuple[Frame, str | None]:
        """Give the frame where it was taken, and what is to be said against learning it there."""
        if frame.position:  # a recording's own: no echo of anything
            return frame, None
        if vehicle is None or not vehicle.is_fresh_at(frame.t_mono_s):
            return frame, "without a fresh position"
        if not vehicle.has_gps:  # it reckons, and goes on saying so
            return frame, "without GPS"
        if frame.t_mono_s - self._t_fix_s < _ECHO_S:
            return frame, "just after a fix"
        position = Position(vehicle.lat_deg, vehicle.lon_deg, vehicle.alt_m)
        return replace(frame, position=position, heading_deg=vehicle.heading_deg, t_utc_s=self._utc_clock()), None

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
