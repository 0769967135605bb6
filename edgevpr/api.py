"""The Python interface: `edgevpr.build` builds a map, `edgevpr.Map` matches images with it. This interface is stable;
everything else in the package may change from version to version.

    import cv2, edgevpr

    edgevpr.build("valley.gpkg", "photos/", camera="nadir")
    with edgevpr.Map("valley.gpkg") as valley:
        match = valley.match(cv2.imread("later.jpg"), heading_deg=90)
    print(match.position, match.accuracy_m, match.reason)"""

import logging
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from edgevpr.core import text
from edgevpr.core.arrays import Covariance, Image
from edgevpr.core.config import load_config
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.reasons import Reason
from edgevpr.core.types import Frame, Place, Position
from edgevpr.mapmaking.making import BuiltMap, MapPlan, make_map
from edgevpr.mapmaking.pictures import FlightPictures, OrthophotoGrid
from edgevpr.power.boards import load_board, resolve_board
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.runtime.recognise.recognition import Recognition

Progress = Callable[[int, int, str], None]  # called with the number of items done, their total, and a label

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """Result of matching one image. None: unknown, or no place was found.

    `accepted`: the match with `place` was accepted. `reason`: why it was or was not, as a code with parameters;
    `str(reason)` is a sentence. `confidence`: probability that the image shows the place. `position`: position of the
    aircraft, if accepted. `accuracy_m`: its standard deviation in metres. `covariance_m2`: (variance east, covariance,
    variance north). `of_place`: `position` is simply that of the place, because the offset from it is unknown.
    `heading_deg`: compass direction of the top of the image. `rotation_deg`: rotation of the image relative to the
    place's image, clockwise. `t_query_s`: processing time in seconds."""

    accepted: bool
    reason: Reason
    place: Place | None
    score: float | None
    confidence: float | None
    position: Position | None
    accuracy_m: float | None
    covariance_m2: Covariance | None
    of_place: bool
    heading_deg: float | None
    rotation_deg: float | None
    t_query_s: float

    def geojson(self) -> dict[str, Any]:
        """Return the position as a GeoJSON feature; its geometry is None if there is no position."""
        properties = {
            "accepted": self.accepted,
            "reason": self.reason.code.name,
            "confidence": self.confidence,
            "accuracy_m": self.accuracy_m,
            "place": self.place and self.place.place_id,
        }
        position = self.position
        geometry = position and {"type": "Point", "coordinates": [position.lon_deg, position.lat_deg]}
        return {"type": "Feature", "geometry": geometry, "properties": properties}


class Map:
    """A map file, opened for matching.

    `config`: flight configuration file (None: the defaults). `fov_deg`: field of view across the longest side of the
    images; if given, they are levelled and scaled by attitude and height. `accept_precision`: confidence that a match
    must reach. `follow`: the images are those of one flight, in order. Raises EdgevprError for a map that cannot be
    used. Not thread-safe."""

    def __init__(
        self,
        path: str | Path,
        *,
        config: str | Path | None = None,
        fov_deg: float | None = None,
        accept_precision: float | None = None,
        follow: bool = False,
    ) -> None:
        overrides = {"map": _to_path(path), "source.fov_deg": fov_deg, "match.accept_precision": accept_precision}
        settings = load_config(config, overrides)
        source = settings.source
        known_fields = ("heading", "height", "reach") if source.fov_deg or source.lens else ("heading", "reach")
        board = resolve_board(load_board(settings.board), source, settings.memory)
        self._recogniser = open_recogniser(settings, board, known=known_fields, tracks_flight=follow)
        is_nadir = self._recogniser.technique.spec.looks_down
        self._needs_height = source.fov_deg is not None or (source.lens is not None and is_nadir)
        self._is_open, self._threads = True, ThreadpoolController()

    def __enter__(self) -> "Map":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._recogniser.place_map)

    def close(self) -> None:
        """Close the file."""
        self._is_open = False
        self._recogniser.place_map.close()

    def places(self) -> Iterator[Place]:
        """Yield the places while reading the file: number, image, position, heading and pose of each."""
        yield from self._recogniser.place_map.read_places()

    def match(
        self,
        image: Image,
        *,
        heading_deg: float | None = None,
        height_m: float | None = None,
        roll_deg: float | None = None,
        pitch_deg: float | None = None,
        near: Position | None = None,
        t_s: float | None = None,
    ) -> Match:
        """Find the place of an image, uint8 (H, W) grey or (H, W, 3) blue, green, red.

        `heading_deg`: compass direction of the nose. `height_m`: above ground; used, and then required, only with
        `fov_deg` or a `lens` in the configuration. `roll_deg`, `pitch_deg`: as in `Frame`. `near`: assumed position;
        places within 300 m are searched, and a few others in case it is wrong. `t_s`: capture time, seconds on any
        clock (None: now); used only with `follow`. Raises ImageError for an image that cannot be used, UsageError for
        a missing height or an invalid value."""
        if not self._is_open:
            raise UsageError("The map is closed: match within its `with` block, or before close().")
        _check_image(image)
        numbers = {"heading_deg": heading_deg, "height_m": height_m, "roll_deg": roll_deg, "pitch_deg": pitch_deg}
        for name, value in {**numbers, "t_s": t_s}.items():
            if value is not None and not (isinstance(value, int | float | np.number) and math.isfinite(value)):
                raise UsageError(f"{name} is {value!r}, but must be a finite number, or None if unknown.")
        if near is not None and not isinstance(near, Position):
            raise UsageError(f"near is {near!r}, but must be an edgevpr.core.types.Position(lat_deg, lon_deg).")
        if self._needs_height and height_m is None:
            raise UsageError("The map was opened with a lens or field of view: pass height_m with each picture.")
        frame = Frame(
            image=image,
            name="",
            t_mono_s=time.monotonic() if t_s is None else t_s,
            position=near,
            heading_deg=heading_deg,
            roll_deg=roll_deg,
            pitch_deg=pitch_deg,
            height_m=height_m,
        )
        # More threads do not speed up products of small matrices, but spin: measured, eight times the CPU time.
        with self._threads.limit(limits=1, user_api="blas"):
            event = self._recogniser.step(frame)
        if event.failed:
            raise ImageError(str(event.reason))
        return _to_match(event)


def _to_match(event: Recognition) -> Match:
    best, located, cost = event.best, event.located, event.cost
    return Match(
        accepted=event.accepted,
        reason=event.reason,
        place=best.place if best else None,
        score=best.match.score if best else None,
        confidence=event.confidence,
        position=event.position,
        accuracy_m=event.accuracy_m,
        covariance_m2=located.covariance_m2 if located else None,
        of_place=bool(located and not located.places),
        heading_deg=located.heading_deg if located else None,
        rotation_deg=best.match.rotation_deg if best else None,
        t_query_s=cost.t_encode_s + cost.t_match_s,
    )


def build(
    path: str | Path,
    images: str | Path | FlightPictures | OrthophotoGrid,
    *,
    camera: str | None = None,
    technique: str | None = None,
    config: str | Path | None = None,
    refine: bool = True,
    calibrate: bool = True,
    progress: Progress | None = None,
) -> BuiltMap:
    """Build a map as `edgevpr map build` does. `progress` is called after each image (None: it is shown on stderr).

    `images`: a folder of images or a video, `FlightPictures` to specify more, or `OrthophotoGrid` for an orthophoto.
    `camera`: "nadir" or "forward". `technique`: name (None: cohog). `config`: flight configuration file
    (None: the defaults). Images that cannot be used are left out with a warning; so is a refinement or
    calibration that is not possible. Raises EdgevprError."""
    source = images if isinstance(images, FlightPictures | OrthophotoGrid) else FlightPictures(source=_to_path(images))
    plan = MapPlan(
        path=_to_path(path), pictures=source, technique=technique, parameters={}, refine=refine, calibrate=calibrate
    )
    settings = load_config(config, {"source.camera": camera})
    show = text.progress if progress is None else _wrap_progress(progress)
    with ThreadpoolController().limit(limits=1, user_api="blas"):
        built_map = make_map(plan, settings, lambda error: _log.warning("%s", error), show)
    for sentence in built_map.not_done:
        _log.warning("%s", sentence)
    return built_map


def _wrap_progress(progress: Progress) -> Any:
    def report(items: Iterable[Any], total: int, label: str) -> Iterator[Any]:
        for done, item in enumerate(items, 1):
            yield item
            progress(done, total, label)

    return report


def _to_path(path: object) -> str:
    if not isinstance(path, str | os.PathLike):
        raise UsageError(f"{path!r} is not a path: pass a string or a pathlib.Path.")
    return os.fspath(path)


def _check_image(image: object) -> None:
    """Raise ImageError for anything that is not an image."""
    hint = "pass a NumPy array of uint8, (H, W) grey or (H, W, 3) blue, green, red, as cv2.imread returns"
    if not isinstance(image, np.ndarray):
        cause = " (cv2.imread returns None for an unreadable file)" if image is None else ""
        raise ImageError(f"The picture has the type {type(image).__name__}: {hint}{cause}.")
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)) or image.ndim < 2 or 0 in image.shape:
        raise ImageError(f"The picture is {image.dtype} with shape {image.shape}: {hint}.")


__all__ = ("FlightPictures", "Map", "Match", "OrthophotoGrid", "build")
