"""The three maps of a frame and their scores (thesis 3.2): memorability, staticity, entropy; and a picture of them."""

from dataclasses import dataclass

import cv2
import numpy as np

from edgevpr.core.arrays import Image, Mask, Singles
from edgevpr.core.types import Salience
from edgevpr.runtime.recognise.memorability import Memorability, as_map
from edgevpr.techniques.entropy import filled_bins

# Of the longer side on which entropy is computed: a larger copy costs more and says the same.
_LONGEST_PX = 320
_WIDTH_PX = 480  # of one panel
_CAPTION_PX = 34
_GAP_PX = 6
_MOST_ENTROPY = 0.8  # drawn as full: a disc of 81 pixels has no more
_WEIGHT = 0.55  # of the colours over the picture
_DYNAMIC = (40, 40, 220)  # BGR


@dataclass(frozen=True, slots=True)
class Maps:
    """`memorability` float32 in 0..1, `is_static` bool, `entropy` float32 in 0..1 (bits over 8): (H, W) each, of one
    size; None for what is not looked at."""

    memorability: Singles | None
    is_static: Mask | None
    entropy: Singles


def maps_of(image: Image, memorability: Memorability | None, is_static: Mask | None) -> Maps:
    """Compute the maps of uint8 (H, W[, 3]), the longer side of each 320 pixels at most.

    `is_static` bool (H, W) is what a detector says of the picture (None: there is none). Raises ModelError.
    """
    grey = _small_grey(image)
    if is_static is not None:
        covered = cv2.resize((~is_static).astype(np.float32), grey.shape[::-1], interpolation=cv2.INTER_AREA)
        is_static = covered < 0.5
    return Maps(
        memorability=None if memorability is None else as_map(memorability.matrix(image), grey.shape),
        is_static=is_static,
        entropy=filled_bins(grey),
    )


def scores_of(maps: Maps) -> Salience:
    """Average the maps over the whole picture. What is not static counts as 0 in the other two, because less is known
    of such a picture."""
    static = 1.0 if maps.is_static is None else maps.is_static
    return Salience(
        memorability=None if maps.memorability is None else float((maps.memorability * static).mean()),
        staticity=None if maps.is_static is None else float(maps.is_static.mean()),
        entropy=float((maps.entropy * static).mean()),
    )


def panels(image: Image, maps: Maps, salience: Salience) -> Image:
    """Draw the picture and its maps over it, two by two: uint8 (H, W, 3) BGR. Blue is little, red is much."""
    height = round(_WIDTH_PX * image.shape[0] / image.shape[1])
    colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    ground = cv2.resize(colour, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    drawn = [
        _captioned(ground, "picture"),
        _captioned(_over(ground, maps.memorability, 1.0), f"memorability {in_words(salience.memorability)}"),
        _captioned(_covered(ground, maps.is_static), f"staticity {in_words(salience.staticity)}"),
        _captioned(_over(ground, maps.entropy, _MOST_ENTROPY), f"entropy {in_words(salience.entropy)}"),
    ]
    framed = [cv2.copyMakeBorder(each, *(_GAP_PX,) * 4, cv2.BORDER_CONSTANT, value=(255,) * 3) for each in drawn]
    return np.vstack([np.hstack(framed[:2]), np.hstack(framed[2:])])


def png(drawn: Image) -> bytes:
    """Encode a picture as a PNG file."""
    return cv2.imencode(".png", drawn)[1].tobytes()


def _small_grey(image: Image) -> Image:
    shrink = _LONGEST_PX / max(image.shape[:2])
    if shrink < 1:
        size = tuple(max(1, round(side * shrink)) for side in image.shape[1::-1])
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def _over(ground: Image, values: Singles | None, full: float) -> Image:
    if values is None:
        return ground
    levels = np.clip(values / full * 255, 0, 255).astype(np.uint8)
    levels = cv2.resize(levels, ground.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return cv2.addWeighted(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO), _WEIGHT, ground, 1 - _WEIGHT, 0)


def _covered(ground: Image, is_static: Mask | None) -> Image:
    if is_static is None:
        return ground
    static = cv2.resize(is_static.astype(np.uint8), ground.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    drawn = ground.copy()
    drawn[static == 0] = (_WEIGHT * np.array(_DYNAMIC) + (1 - _WEIGHT) * drawn[static == 0]).astype(np.uint8)
    return drawn


def _captioned(panel: Image, text: str) -> Image:
    drawn = cv2.copyMakeBorder(panel, _CAPTION_PX, 0, 0, 0, cv2.BORDER_CONSTANT, value=(255,) * 3)
    cv2.putText(drawn, text, (4, _CAPTION_PX - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (40, 40, 40), 1, cv2.LINE_AA)
    return drawn


def in_words(score: float | None) -> str:
    """Say a score in words: two digits, or that it is off."""
    return "off" if score is None else f"{score:.2f}"
