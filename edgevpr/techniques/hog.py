"""`hog`: one histogram-of-oriented-gradients vector for the whole image, compared by cosine.

Dalal and Triggs 2005, in the form of thesis 4.2.1: 512x512 grey, cells of 8x8 pixels, blocks of 16x16 with a stride of
one cell, 9 orientations over 180 degrees.
"""

from typing import ClassVar

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.techniques.gradients import grey_square, mask_square, normalised_blocks, oriented_cells
from edgevpr.techniques.vectors import VectorTechnique


class Hog(VectorTechnique):
    """Whole-image HOG; the descriptor has length 1 and is kept in half precision (286 KB per place by default)."""

    # Every wrong match on corridor and aerial_caliterra (the data sets used for tuning) had a margin below 0.022
    # (float), 0.024 (8bit), 0.017 (1bit).
    accept: ClassVar = {"float": (0.0, 0.03), "8bit": (0.0, 0.03), "1bit": (0.0, 0.02)}

    def __init__(self, w1: int = 512, cell: int = 8, bins: int = 9, form: str = "float") -> None:
        if not (cell >= 2 and w1 % cell == 0 and 2 * cell <= w1 <= 4096 and 2 <= bins <= 64):
            raise UsageError(
                f"hog cannot use w1={w1}, cell={cell}, bins={bins}: w1 must be a multiple of cell (at least 2 cells "
                "of 2 pixels, at most 4096 pixels), bins 2 to 64."
            )
        self._w1, self._cell, self._bins = w1, cell, bins
        length = (w1 // cell - 1) ** 2 * 4 * bins
        super().__init__("hog", {"w1": w1, "cell": cell, "bins": bins}, length, form=form)

    def vector(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """Encode uint8 (H, W[, 3]) to float32 (length,); gradients where `mask` bool (H, W) is False are left out."""
        grey = grey_square(image, self._w1)
        allowed = mask_square(mask, self._w1)
        cells = oriented_cells(grey, self._cell, self._bins, signed=False, allowed=allowed)
        return normalised_blocks(cells).ravel()
