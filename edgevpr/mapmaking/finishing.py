"""Finishes a map after its places have been made: refines their positions and calibrates its confidence. The commands
`edgevpr map refine` and `map calibrate` each do one of these steps for an existing map."""

import logging
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from edgevpr.core.config import MatchConfig, SourceConfig
from edgevpr.core.contract import Technique
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.text import Progress
from edgevpr.core.types import Frame
from edgevpr.frames.mask import load_mask
from edgevpr.frames.source import read_to_end
from edgevpr.mapmaking.headings import find_headings, lacks_heading
from edgevpr.mapmaking.pictures import FlightPictures, OrthophotoGrid
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.calibration import MapCalibration
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.evidence import list_evidence_kinds
from edgevpr.runtime.recognise.levelling import Levelling, make_levelling

if TYPE_CHECKING:
    from edgevpr.mapmaking.refine import Refinement

_log = logging.getLogger(__name__)


def finish_map(
    place_map: PlaceMap,
    encoder: FrameEncoder,
    match: MatchConfig,
    pictures: FlightPictures | OrthophotoGrid | None,
    progress: Progress,
    refine: bool = True,
    calibrate: bool = True,
) -> "tuple[Refinement | None, MapCalibration | None, tuple[str, ...]]":
    """Refine and calibrate an open map, as far as its technique allows. `pictures` None: not available, so the map is
    not calibrated. Return the results of the two steps (None: not done), and a sentence for each requested step that
    failed, with the reason. Failures are not raised, because a map is usable without these steps."""
    technique, refined, calibration, not_done = encoder.technique, None, None, []
    if refine and technique.spec.looks_down and not isinstance(pictures, OrthophotoGrid):
        try:
            refined = refine_map(place_map, technique, pictures.folder if pictures else None, progress)
        except EdgevprError as error:
            not_done.append(f"the map was not refined: {error}")
    if calibrate and pictures and list_evidence_kinds(technique.spec):
        try:
            calibration = calibrate_map(place_map, encoder, match, pictures, progress)
        except EdgevprError as error:
            not_done.append(f"the map was not calibrated: {error}")
    return refined, calibration, tuple(not_done)


def refine_map(
    place_map: PlaceMap, technique: Technique, images: str | Path | None, progress: Progress
) -> "Refinement":
    """Refine the positions of an open map (see `refine`). `images` is the folder of its pictures (None: not available).
    Raises UsageError if the map's technique cannot be refined, or SciPy is missing."""
    if not technique.spec.looks_down:
        raise UsageError(
            f"{place_map.path} cannot be refined: it was made with {technique.spec.name}, not for a camera that looks "
            "straight down. Only maps made with `cohog` and `--camera nadir` can be refined."
        )
    with _require_scipy():
        from edgevpr.mapmaking.refine import MAX_TURN_DEG, refine
    refined = refine(place_map, technique, progress, images)
    if refined.is_mirrored:
        _log.warning(
            "lat and lon may be swapped, one may have the wrong sign (south and west are negative), or the camera is "
            "tilted: the pictures fit the mirror image of their positions, so %s was not refined; check columns and "
            "camera, then rebuild the map",
            place_map.path,
        )
    if abs(refined.turned_deg) > MAX_TURN_DEG:
        _log.warning(
            "pictures fit their positions only if turned by %.0f degrees from their recorded headings: rows may be in "
            "another order, signs of lat and lon lost, or `source.up_deg` unset, so %s was not refined; correct this, "
            "then rebuild the map",
            abs(refined.turned_deg),
            place_map.path,
        )
    if refined.common_offset_m:
        _log.warning(
            "the recorded positions are about %.0f m away from their images, always in the same direction from the "
            "camera: it is probably tilted, or triggers late. Record roll_deg and pitch_deg, set "
            "source.mount_ahead_deg and source.mount_right_deg, or correct the times; until then, all fixes claim this "
            "error",
            refined.common_offset_m,
        )
    if refined.displaced:
        _log.warning(
            "the positions of the images from %s to %s are displaced together by %.0f m against all others, as by "
            "another log or base station: correct them and rebuild the map; until then, all fixes claim this error",
            *refined.displaced,
        )
    return refined


def calibrate_map(
    place_map: PlaceMap,
    encoder: FrameEncoder,
    match: MatchConfig,
    pictures: FlightPictures | OrthophotoGrid,
    progress: Progress,
) -> MapCalibration:
    """Calibrate the confidence of an open map with the pictures that it was made from, skipping those that cannot be
    read (see `calibrate`). Raises UsageError if the map cannot be calibrated, or SciPy is missing."""
    with _require_scipy():
        from edgevpr.mapmaking.calibrate import calibrate

    levelling, looks_down = encoder.levelling, encoder.technique.spec.looks_down
    lens = levelling.lens if looks_down and isinstance(levelling, Levelling) else None
    open_pictures = (
        partial(pictures.open, upright=not looks_down) if isinstance(pictures, FlightPictures) else pictures.open
    )

    def read(names: Collection[str] | None) -> Iterator[Frame]:
        yield from filter(None, read_to_end(open_pictures(names), lambda error: None))

    def frames(names: Collection[str]) -> Iterator[Frame]:
        first = next(read(names), None)
        if lens is None or first is None or not lacks_heading(first, lens):
            yield from read(names)
        else:  # the motion between neighbours is needed, so every image is read
            yield from (frame for frame in find_headings(read(None), lens) if frame.name in names)

    return calibrate(encoder, place_map, match, QueryMeter(load_board("this")), frames, progress)


def make_encoder(
    source: SourceConfig, pictures: FlightPictures | OrthophotoGrid | None, technique: Technique
) -> FrameEncoder:
    """Return the encoder for places, with mask and levelling unless the pictures are cut from an orthophoto."""
    if isinstance(pictures, OrthophotoGrid):
        return FrameEncoder(technique=technique)
    levelling = make_levelling(source, technique, below=True)
    return FrameEncoder(technique=technique, mask=load_mask(source.mask), levelling=levelling)


@contextmanager
def _require_scipy() -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as error:
        raise UsageError(
            f"Refining and calibrating a map require SciPy ({error}): run `pip install scipy` on the machine that "
            "builds maps, then `edgevpr map refine` and `edgevpr map calibrate`."
        ) from error
