"""One picture of a camera or stream as it arrives, and the contract of all that gives such pictures."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np


class Refusal(Enum):
    """The reason for which a picture is refused. DAMAGED: it is not whole, or predicted from one that is not. PATCHED:
    parts of it are those of an older one. FROZEN: it is the one before again. LATE: how old it is cannot be told, as it
    has waited since before the opening, or comes out of turn; or it came sooner than those before could be decoded."""

    DAMAGED = "damaged"
    PATCHED = "patched"
    FROZEN = "frozen"
    LATE = "late"


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """A whole picture. `t_mono_s` is the time at which it was taken, as far as that is known: never later than it
    arrived. `look` is a coarse copy in grey, uint8, (h, w). `pixels` makes the picture, uint8, (H, W, 3) BGR or (H, W)
    grey: only a picture that is read costs its conversion."""

    t_mono_s: float
    look: np.ndarray
    pixels: Callable[[], np.ndarray]


class Capture(Protocol):
    """An open camera or stream, used by one thread from opening to release."""

    def read(self) -> Shot | Refusal | None:
        """Wait for the next picture and return it, or the reason why it is refused; None where the source is lost."""
        ...

    def release(self) -> None:
        """Close the camera or the connection."""
        ...
