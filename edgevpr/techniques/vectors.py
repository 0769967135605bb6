"""Base class of the techniques that describe an image by one vector, with three forms in RAM; and `hog`.

The map file and the form `float` store half precision. `8bit` and `1bit` subtract the mean of all vectors in the map,
which all places have in common, and store one byte or one bit per value."""

from typing import Any

import numpy as np

from edgevpr.core.arrays import Array, Bytes, Image, Ints, Mask, Singles
from edgevpr.core.config import FORMS
from edgevpr.core.contract import Descriptor, PartSpec, TechniqueSpec
from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques.gradients import compute_histograms, make_grey_square, make_mask_square, normalise_blocks

# A margin that no match reaches. The margins of wrong matches are known for the shipped weights only: with other
# weights no match is accepted until the configuration sets a minimum margin.
UNREACHABLE_MARGIN = 2.0
_SHIPPED_MODEL = "calc"
_TINY = 1e-6
_BLOCK_BYTES = 4 << 20  # of places converted to float32 together
_MIN_BLOCK_PLACES = 16
_SUFFIX_BYTES = 8  # at the end of an `8bit` row: quantisation step and length, both float32
_WORD_BITS = 64  # a `1bit` row is padded to words of this size, whose bits are counted together
_CODE_BLOCK_BYTES = 1 << 20  # of binary vectors compared together; about the size of an L2 cache


class VectorTechnique:
    """Base class of the techniques that compare one vector with those of all places in RAM; a subclass implements
    `make_vector`. `form` is the form of the vectors in RAM (see above).

    All scores are 0 to 1. With `similarity` "cosine", the score in the form `float` is the cosine (0 if negative), and
    in `8bit` (1 + cosine) / 2 after subtraction of the map's mean. With "l1" it is 1 / (1 + distance). In `1bit` it is
    the fraction of equal bits. `margins` are the minimum margins of an accepted match in the three forms. They hold for
    the shipped weights: with another `model`, no match is accepted until the configuration sets a minimum margin."""

    candidates = 1  # there is no fine part to compare
    min_score = 0.0
    min_quality = 0.5  # the quality is 0 or 1

    def __init__(
        self,
        name: str,
        length: int,
        *,
        parameters: dict[str, Any] | None = None,
        form: str,
        margins: tuple[float, ...],
        similarity: str = "cosine",
        model_sha256: str | None = None,
    ) -> None:
        if form not in FORMS:
            raise UsageError(f"{name} cannot store vectors as `{form}`: use {', '.join(FORMS[:-1])} or {FORMS[-1]}.")
        parameters = parameters or {}
        has_shipped_model = parameters.get("model", _SHIPPED_MODEL) == _SHIPPED_MODEL
        self.min_margin = margins[FORMS.index(form)] if has_shipped_model else UNREACHABLE_MARGIN
        self._similarity, self._length = similarity, length
        self._block_places = max(_BLOCK_BYTES // (4 * length), _MIN_BLOCK_PLACES)
        packed = {
            "float": None,
            "8bit": PartSpec((length + _SUFFIX_BYTES,), "|i1"),
            "1bit": PartSpec((-(-length // _WORD_BITS) * _WORD_BITS // 8,), "|u1"),
        }
        coarse = PartSpec((length,), "<f2")
        self.spec = TechniqueSpec(
            name=name, parameters=parameters, coarse=coarse, model_sha256=model_sha256, packed=packed[form], form=form
        )

    def make_vector(self, image: Image, mask: Mask | None) -> Singles:
        """Make the vector of a uint8 image (H, W[, 3]): float32 (D,). Pixels where `mask` bool (H, W) is False must
        have no influence (None: use all)."""
        raise NotImplementedError

    def encode(self, image: Image, mask: Mask | None = None) -> Descriptor:
        """Encode uint8 (H, W[, 3]) to coarse float16 (D,), of length 1 if the similarity is the cosine. The quality is
        1, or 0 if all values are 0 in half precision. Raises ModelError for values beyond half precision."""
        vector = self.make_vector(image, mask)
        length = float(np.linalg.norm(vector))
        if self._similarity == "cosine":
            vector = vector / max(length, _TINY)
        if not np.abs(vector).max() <= np.finfo(np.float16).max:
            raise ModelError(
                f"{self.spec.name}: its vector has values outside the half-precision range "
                f"({np.abs(vector).max():.3g}): scale the network's output, or compare by cosine."
            )
        coarse = vector.astype("<f2")
        return Descriptor(coarse=coarse, quality=float(coarse.any()))

    def pack(self, coarse: Array, mean: Singles) -> Array:
        """Make the rows in RAM of the forms `8bit` and `1bit`, (N, *row shape), from the vectors `coarse`, float16 (N,
        D), and the map's mean (D,). A row of `8bit` is D int8 values, then the bytes of two float32: quantisation step
        and length."""
        rows = np.zeros((len(coarse), *self.spec.row.shape), self.spec.row.dtype)
        for start in range(0, len(coarse), self._block_places):
            block = slice(start, start + self._block_places)
            deviations = coarse[block].astype(np.float32)
            deviations -= mean
            if self.spec.form == "1bit":
                rows[block, : -(-self._length // 8)] = np.packbits(deviations > 0, axis=1)
                continue
            step = np.maximum(np.abs(deviations).max(axis=1), np.finfo(np.float32).tiny) / 127
            levels = np.rint(np.divide(deviations, step[:, None], out=deviations), out=deviations)
            length = step * np.sqrt(np.einsum("nd,nd->n", levels, levels))
            rows[block, : self._length] = levels
            rows[block, self._length :] = np.stack([step, length], axis=1).astype("<f4").view(np.int8)
        return rows

    def score_places(self, query: Descriptor, rows: Array, mean: Singles | None = None) -> tuple[Singles, None]:
        """Compare a query with the `rows` (N, *row shape) of all places; `mean` (D,) is the map's mean. Returns scores
        float32 (N,), all 0 for an all-zero query, and None (no hypotheses)."""
        vector = query.coarse.astype(np.float32)
        if not vector.any():  # after subtraction of the mean, zeros would resemble some places
            return np.zeros(len(rows), np.float32), None
        if mean is not None and self.spec.form != "float":
            vector -= mean
        if self.spec.form == "1bit":
            return self._score_bits(vector, rows), None
        scores = np.empty(len(rows), np.float32)
        values = np.empty((min(self._block_places, len(rows)), self._length), np.float32)
        for start in range(0, len(rows), self._block_places):
            part = rows[start : start + self._block_places]
            np.copyto(values[: len(part)], part[:, : self._length])
            suffix = np.ascontiguousarray(part[:, self._length :]).view("<f4").T
            scores[start : start + len(part)] = self._compare_vectors(vector, values[: len(part)], suffix)
        return scores, None

    def _score_bits(self, vector: Singles, rows: Bytes) -> Singles:
        """Return the fraction of equal bits of a vector and each of n places, uint8 (n, B): float32 (n,)."""
        code = np.zeros(self.spec.row.shape, np.uint8)
        code[: -(-self._length // 8)] = np.packbits(vector > 0)
        query, places = code.view(np.uint64), np.ascontiguousarray(rows).view(np.uint64)
        differing_bits: Ints = np.empty(len(rows), np.uint16 if 8 * len(code) < 1 << 16 else np.uint32)
        ones = np.ones(len(query), np.float32)  # a matrix product is the fastest sum, and exact below 2^24
        block_places = max(1, _CODE_BLOCK_BYTES // len(code))
        for start in range(0, len(rows), block_places):
            block = slice(start, start + block_places)
            differing_bits[block] = np.bitwise_count(places[block] ^ query).astype(np.float32) @ ones
        return np.asarray(1 - differing_bits / np.float32(self._length), np.float32)

    def _compare_vectors(self, vector: Singles, values: Singles, suffix: Singles) -> Singles:
        """Score n places by their vectors `values`, float32 (n, D), which are overwritten. In the form `8bit`, `suffix`
        (2, n) has the places' steps and lengths; in `float` it is empty, (0, n)."""
        if self._similarity == "cosine":
            scores: Singles = values @ vector
            if not len(suffix):
                return np.clip(scores, 0, 1, out=scores)
            step, length = suffix
            scores *= step
            scores /= np.maximum(length * np.linalg.norm(vector), np.finfo(np.float32).tiny)
            return np.clip((1 + scores) / 2, 0, 1)
        if len(suffix):
            values *= suffix[0][:, None]
        values -= vector
        return np.asarray(1 / (1 + np.abs(values, out=values).sum(axis=1)))


class Hog(VectorTechnique):
    """`hog`: one histogram-of-oriented-gradients vector for the whole image, compared by cosine (286 KB per place by
    default). Dalal and Triggs 2005, as in thesis 4.2.1: 512x512 grey (`w1`), cells of 8x8 pixels (`cell`), blocks of
    2x2 cells, stride one cell, 9 orientations (`bins`) over 180 degrees."""

    def __init__(self, w1: int = 512, cell: int = 8, bins: int = 9, form: str = "float") -> None:
        if not (cell >= 2 and w1 % cell == 0 and 2 * cell <= w1 <= 4096 and 2 <= bins <= 64):
            raise UsageError(
                f"hog cannot use w1={w1}, cell={cell}, bins={bins}: w1 must be a multiple of cell (at least 2 cells "
                "of 2 pixels, at most 4096 pixels), bins 2 to 64."
            )
        self._side_px, self._cell, self._bins = w1, cell, bins
        length = (w1 // cell - 1) ** 2 * 4 * bins
        # Every wrong match on corridor and aerial_caliterra (the data sets used for tuning) had a margin below 0.022
        # (float), 0.024 (8bit), 0.017 (1bit).
        margins = (0.03, 0.03, 0.02)
        super().__init__("hog", length, parameters={"w1": w1, "cell": cell, "bins": bins}, form=form, margins=margins)

    def make_vector(self, image: Image, mask: Mask | None) -> Singles:
        """Encode uint8 (H, W[, 3]) as float32 (length,); gradients where `mask` bool (H, W) is False are ignored."""
        grey = make_grey_square(image, self._side_px)
        allowed = make_mask_square(mask, self._side_px)
        cells = compute_histograms(grey, self._cell, self._bins, signed=False, allowed=allowed)
        return normalise_blocks(cells).ravel()
