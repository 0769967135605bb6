"""The three maps of a picture beside it, as figure 3.6 of the thesis."""

import cv2
import numpy as np

from edgevpr.core.types import Salience
from edgevpr.runtime.recognise.salience_maps import Maps

_WIDTH_PX = 480  # of one panel
_CAPTION_PX = 34
_GAP_PX = 6
_MOST_ENTROPY = 0.8  # drawn as full: a disc of 81 pixels has no more
_WEIGHT = 0.55  # of the colours over the picture
_DYNAMIC = (40, 40, 220)  # BGR


def panels(image: np.ndarray, maps: Maps, salience: Salience) -> np.ndarray:
    """Draw the picture and its maps over it, two by two: uint8 (H, W, 3) BGR. Blue is little, red is much."""
    height = round(_WIDTH_PX * image.shape[0] / image.shape[1])
    colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    ground = cv2.resize(colour, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    drawn = [
        _captioned(ground, "picture"),
        _captioned(_over(ground, maps.memorability, 1.0), f"memorability {said(salience.memorability)}"),
        _captioned(_covered(ground, maps.is_static), f"staticity {said(salience.staticity)}"),
        _captioned(_over(ground, maps.entropy, _MOST_ENTROPY), f"entropy {said(salience.entropy)}"),
    ]
    framed = [cv2.copyMakeBorder(each, *(_GAP_PX,) * 4, cv2.BORDER_CONSTANT, value=(255,) * 3) for each in drawn]
    return np.vstack([np.hstack(framed[:2]), np.hstack(framed[2:])])


def png(drawn: np.ndarray) -> bytes:
    """Encode a picture as a PNG file."""
    return cv2.imencode(".png", drawn)[1].tobytes()


def _over(ground: np.ndarray, values: np.ndarray | None, full: float) -> np.ndarray:
    if values is None:
        return ground
    levels = np.clip(values / full * 255, 0, 255).astype(np.uint8)
    levels = cv2.resize(levels, ground.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return cv2.addWeighted(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO), _WEIGHT, ground, 1 - _WEIGHT, 0)


def _covered(ground: np.ndarray, is_static: np.ndarray | None) -> np.ndarray:
    if is_static is None:
        return ground
    static = cv2.resize(is_static.astype(np.uint8), ground.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    drawn = ground.copy()
    drawn[static == 0] = (_WEIGHT * np.array(_DYNAMIC) + (1 - _WEIGHT) * drawn[static == 0]).astype(np.uint8)
    return drawn


def _captioned(panel: np.ndarray, text: str) -> np.ndarray:
    drawn = cv2.copyMakeBorder(panel, _CAPTION_PX, 0, 0, 0, cv2.BORDER_CONSTANT, value=(255,) * 3)
    cv2.putText(drawn, text, (4, _CAPTION_PX - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (40, 40, 40), 1, cv2.LINE_AA)
    return drawn


def said(score: float | None) -> str:
    """Return a score in words: two digits, or that it is off."""
    return "off" if score is None else f"{score:.2f}"
