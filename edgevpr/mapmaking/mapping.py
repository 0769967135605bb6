"""Makes the places of a map from frames: each frame is encoded and written to disk before the next one is read.

With salience criteria (`FrameEncoder.gate`), only frames that reach all thresholds become places. To avoid long gaps
(thesis 3.4.8), the other frames wait. After `max_frames` frames or `max_gap_m` metres without a place, all thresholds
are lowered in steps of 0.03 until some waiting frames pass; these become low-quality places."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from edgevpr.core.errors import ImageError, ModelError
from edgevpr.core.geodesy import distance_m, offset_position, project_to_metres
from edgevpr.core.reasons import ReasonCode
from edgevpr.core.types import Frame, Position, Salience
from edgevpr.places.layers import read_layers
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.rows import escape_name
from edgevpr.runtime.recognise.encoder import EncodedFrame, FrameEncoder, explain_failure
from edgevpr.runtime.recognise.judge import check_texture
from edgevpr.runtime.recognise.levelling import centre_place
from edgevpr.runtime.recognise.salience_gate import GAP_FRAMES, select_best

_NO_PIXELS = np.empty((0, 0), np.uint8)
SelectedFrame = tuple[EncodedFrame, Salience | None]  # a frame that becomes a place, and its salience (None: no gate)


class PlaceSelector:
    """Selects the frames that become places, without long gaps (see above). `max_gap_m` None: distances are ignored."""

    def __init__(self, max_frames: int = GAP_FRAMES, max_gap_m: float | None = None) -> None:
        self._max_frames, self._max_gap_m = max_frames, max_gap_m
        self._waiting: list[EncodedFrame] = []
        self._last: Position | None = None  # of the last place, or of the first frame while there is no place
        self._has_begun = False

    def add_frame(self, encoded: EncodedFrame) -> Iterator[SelectedFrame]:
        """Process the next frame. Yield the frames that now become places, each with its salience (None: no criteria):
        some waiting frames, then this one if it reaches all thresholds. Otherwise this one waits."""
        if encoded.salience is None:
            yield encoded, None
            return
        frame = encoded.frame
        while self._waiting and (len(self._waiting) >= self._max_frames or self._is_too_far(frame.position)):
            yield from self._take_best_waiting()
        if encoded.salience.reason is None:
            self._waiting.clear()
            yield self._record_place(encoded), encoded.salience.scores
        else:
            self._last = self._last or frame.position
            self._waiting.append(replace(encoded, frame=replace(frame, image=_NO_PIXELS)))

    def end(self) -> Iterator[SelectedFrame]:
        """Yield the frames that become places at the end of a recording: the best ones if there is no place yet."""
        if not self._has_begun and self._waiting:
            yield from self._take_best_waiting()

    def _take_best_waiting(self) -> Iterator[SelectedFrame]:
        """Yield the best waiting frames as low-quality places. Others before the last of them are dropped."""
        waiting = [(encoded, encoded.salience) for encoded in self._waiting if encoded.salience]
        best = np.flatnonzero(select_best([salience.shortfall for _, salience in waiting])).tolist()
        self._waiting = self._waiting[best[-1] + 1 :]
        for encoded, salience in (waiting[index] for index in best):
            yield self._record_place(encoded), replace(salience.scores, is_low=True)

    def _record_place(self, encoded: EncodedFrame) -> EncodedFrame:
        self._has_begun, self._last = True, encoded.frame.position or self._last
        return encoded

    def _is_too_far(self, position: Position | None) -> bool:
        if self._max_gap_m is None or position is None or self._last is None:
            return False
        return distance_m(self._last.lat_deg, self._last.lon_deg, position.lat_deg, position.lon_deg) > self._max_gap_m


@dataclass(frozen=True, slots=True, kw_only=True)
class CoveredGround:
    """Ground covered by the places with a position. `north_south_m`, `east_west_m`: its extent. `lat_deg`, `lon_deg`:
    its centre. `track_m`: length of the path through the places in mapping order; `step_m`: its median step."""

    north_south_m: float
    east_west_m: float
    lat_deg: float
    lon_deg: float
    track_m: float
    step_m: float

    def describe(self, is_flown: bool) -> str:
        """Describe the ground in one sentence, including the track if the pictures were taken in flight."""
        lengths_m = self.north_south_m, self.east_west_m, self.track_m, self.step_m
        ns, ew, track, step = (f"{m / 1000:.1f} km" if m >= 1000 else f"{m:.0f} m" for m in lengths_m)
        text = f"the map extends {ns} north-south and {ew} east-west around {self.lat_deg:.5f}, {self.lon_deg:.5f}"
        return f"{text}; the track is {track} long, with a median of {step} between pictures" if is_flown else text


def measure_ground(place_map: PlaceMap) -> CoveredGround | None:
    """Measure the ground that a map covers; None if fewer than two places have a position."""
    points = np.array([(lat_deg, lon_deg) for _, lat_deg, lon_deg, _ in place_map.read_outlines()]).reshape(-1, 2)
    lat_deg, lon_deg = points[~np.isnan(points).any(axis=1)].T
    if len(lat_deg) < 2:
        return None
    east_m, north_m = project_to_metres(lat_deg, lon_deg)
    steps_m = distance_m(lat_deg[:-1], lon_deg[:-1], lat_deg[1:], lon_deg[1:])
    centre_m = [float(axis_m.max() + axis_m.min()) / 2 for axis_m in (east_m, north_m)]
    centre = offset_position(float(lat_deg[0]), float(lon_deg[0]), *centre_m)
    return CoveredGround(
        north_south_m=float(np.ptp(north_m)),
        east_west_m=float(np.ptp(east_m)),
        lat_deg=centre[0],
        lon_deg=centre[1],
        track_m=float(steps_m.sum()),
        step_m=float(np.median(steps_m)),
    )


@dataclass(slots=True, kw_only=True)
class MappingResult:
    """Counts of frames. `added`: new places; `without_position` of these have no position, and `of_low_quality` only
    close a gap. `already_here`: frames that were in the map already. `low_texture`: frames with too little texture.
    `tilted`: frames tilted too far to be levelled. `without_heading`: tilted frames that lack the heading needed to
    level them. `not_memorable`: frames skipped because they failed a salience criterion. `without_data`: places skipped
    because the orthophoto has no data there. `white`: places cut from it that are more than a third white."""

    added: int = 0
    without_position: int = 0
    already_here: int = 0
    of_low_quality: int = 0
    low_texture: int = 0
    tilted: int = 0
    without_heading: int = 0
    not_memorable: int = 0
    without_data: int = 0
    white: int = 0


def build_map(
    frames: Iterable[Frame],
    encoder: FrameEncoder,
    place_map: PlaceMap,
    selector: PlaceSelector | None = None,
    on_error: Callable[[ImageError], None] | None = None,
) -> MappingResult:
    """Add a place for every selected frame that is not in the map yet, so that an interrupted build can be continued.

    Frames are encoded in the same steps as queries. A frame is in the map already if a place has the same name and
    nearly the same descriptor; the name alone is not enough, because cameras restart their numbering. If a frame cannot
    be encoded, `on_error` is called with the error; with `on_error` None, ModelError is raised. Pictures cut from an
    orthophoto (surveyed ones) are skipped if they have too little texture to be recognised."""
    place_map.require_technique(encoder.technique.spec)
    selector = selector or PlaceSelector()
    ids_by_image = place_map.select_ids("source_image")
    result, layers = MappingResult(), read_layers(place_map)

    def add_places(selected: Iterable[SelectedFrame]) -> None:
        for encoded, salience in selected:
            place, landmarks = centre_place(encoded.frame, encoded.view), encoder.pack_landmarks(encoded.picture)
            place_map.add(place, encoded.descriptor, salience, landmarks)
            result.added += 1
            result.without_position += encoded.frame.position is None
            if salience and salience.is_low:
                result.of_low_quality += 1
                result.not_memorable -= 1

    for frame in frames:
        min_quality = encoder.technique.min_quality if frame.pose and frame.pose.is_surveyed else 0.0
        try:
            encoded = encoder.encode(frame, layers=layers)
        except Exception as error:
            if on_error is None:
                raise ModelError(str(explain_failure(error))) from error
            on_error(ImageError(f"{frame.name}: {explain_failure(error)}"))
            continue
        if encoded.view.reason:
            if encoded.view.reason.code is ReasonCode.TILTED_WITHOUT_HEADING:
                result.without_heading += 1
            else:
                result.tilted += 1
            continue
        same_name_ids = ids_by_image.get((escape_name(frame.name),), ())
        if check_texture(encoded.descriptor, min_quality):
            result.low_texture += 1
        elif any(place_map.has_descriptor(place_id, encoded.descriptor.coarse) for place_id in same_name_ids):
            result.already_here += 1
        else:
            result.not_memorable += bool(encoded.salience and encoded.salience.criterion)
            add_places(selector.add_frame(encoded))
    add_places(selector.end())
    return result
