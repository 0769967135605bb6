"""`hog`: one histogram-of-oriented-gradients vector for the whole image, compared by cosine.

Dalal and Triggs 2005, in the form of thesis 4.2.1: 512x512 grey, cells of 8x8 pixels, blocks of 16x16 with a stride of
one cell, 9 orientations over 180 degrees.
"""

import numpy as np

from edgevpr.errors import UsageError
from edgevpr.techniques.gradients import grey_square, mask_square, normalised_blocks, oriented_cells
from edgevpr.types import Descriptor, PartSpec, TechniqueSpec

_ROWS_AT_ONCE = 16  # places turned to float32 together: 9 MB at the thesis's parameters


class Hog:
    """Whole-image HOG; the descriptor has length 1 and is kept in half precision (286 KB a place by default)."""

    candidates = 1  # it has no fine part to compare
    min_score = 0.0
    min_margin = 0.03  # no wrong match of corridor or aerial_caliterra (the sets tuned on) was ahead by 0.022

    def __init__(self, w1: int = 512, cell: int = 8, bins: int = 9) -> None:
        if not (cell >= 2 and w1 % cell == 0 and 2 * cell <= w1 <= 4096 and 2 <= bins <= 64):
            raise UsageError(
                f"hog cannot use w1={w1}, cell={cell}, bins={bins}: w1 must be a multiple of cell (at least 2 cells "
                "of 2 pixels, at most 4096 pixels), bins 2 to 64."
            )
        self._w1, self._cell, self._bins = w1, cell, bins
        length = (w1 // cell - 1) ** 2 * 4 * bins
        self.spec = TechniqueSpec("hog", {"w1": w1, "cell": cell, "bins": bins}, PartSpec((length,), "<f2"))

    def encode(self, image: np.ndarray, mask: np.ndarray | None = None) -> Descriptor:
        """Encode uint8 (H, W[, 3]) -> coarse float16 (length,); where `mask` is False the gradient is left out."""
        grey = grey_square(image, self._w1)
        allowed = mask_square(mask, self._w1)
        cells = oriented_cells(grey, self._cell, self._bins, signed=False, allowed=allowed)
        vector = normalised_blocks(cells).ravel()
        vector /= max(float(np.linalg.norm(vector)), 1e-6)
        return Descriptor(vector.astype("<f2"))

    def coarse_scores(self, query: Descriptor, rows: np.ndarray, mean: None = None) -> tuple[np.ndarray, None]:
        """Cosine of the query with each row: `rows` float16 (N, length) -> float32 (N,) in 0..1."""
        vector = query.coarse.astype(np.float32)
        scores = np.empty(len(rows), np.float32)
        for start in range(0, len(rows), _ROWS_AT_ONCE):
            block = slice(start, start + _ROWS_AT_ONCE)
            scores[block] = rows[block].astype(np.float32) @ vector
        return np.clip(scores, 0, 1, out=scores), None
