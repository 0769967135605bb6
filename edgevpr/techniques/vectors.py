"""Techniques that make one vector of a picture: the three forms of a vector in RAM, and the comparison of two vectors.

The map file keeps each vector in half precision. In RAM it is kept so (`float`) or, less the mean of the map, as one
byte (`8bit`) or one bit (`1bit`) a number. The mean is common to all places: it does not help to tell them apart, and
takes most of the range of a byte. It changes while a map grows. So the file is independent of the form, and one map
serves all forms.
"""

from typing import ClassVar

import numpy as np

from edgevpr.core.config import FORMS
from edgevpr.core.contract import Descriptor, PartSpec, TechniqueSpec
from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques.hamming import hamming

# A margin that no match can reach. The margins of wrong matches are known for the weights that edgevpr ships. With
# other weights no match is accepted until the configuration sets a minimum margin.
NEVER = 2.0
_SHIPPED = "calc"
_TINY = 1e-6
_BYTES_AT_ONCE = 4 << 20  # of places converted to float32 together
_FEWEST_AT_ONCE = 16
_BESIDE_BYTES = 8  # at the end of a row in 8 bits: its step and its length, both float32
_WORD_BITS = 64  # a row in 1 bit is padded to whole words, whose bits are counted faster


class VectorTechnique:
    """Base class of the techniques that make one vector; a subclass gives `vector`.

    `similarity` is "cosine", "l1" or "l2"; the form `1bit` always compares by Hamming distance. All scores are 0 to 1.
    For "cosine" the score in `float` is the cosine (0 where it is negative: unrelated), in `8bit` (1 + cosine) / 2 of
    the vectors less the mean. For "l1" and "l2" it is 1 / (1 + distance). In `1bit` it is the share of equal bits.
    `accept` gives (min_score, min_margin) of a form, if they are not those of the class. With another `model` than the
    shipped one, no match is accepted until the configuration sets a minimum margin.
    """

    candidates = 1  # there is no fine part to compare
    min_score = 0.0
    min_margin = 0.0
    min_quality = 0.5  # the quality is 0 or 1
    accept: ClassVar[dict[str, tuple[float, float]]] = {}

    def __init__(
        self,
        name: str,
        parameters: dict[str, int | float | str],
        length: int,
        *,
        form: str = "float",
        similarity: str = "cosine",
        model_sha256: str | None = None,
    ) -> None:
        if form not in FORMS:
            raise UsageError(f"{name} has no form `{form}`: use {', '.join(FORMS[:-1])} or {FORMS[-1]}.")
        self.min_score, self.min_margin = self.accept.get(form, (self.min_score, self.min_margin))
        if parameters.get("model", _SHIPPED) != _SHIPPED:
            self.min_margin = NEVER
        self._similarity, self._length = similarity, length
        packed = {
            "float": None,
            "8bit": PartSpec((length + _BESIDE_BYTES,), "|i1"),
            "1bit": PartSpec((-(-length // _WORD_BITS) * _WORD_BITS // 8,), "|u1"),
        }
        self.spec = TechniqueSpec(
            name=name,
            parameters=parameters,
            coarse=PartSpec((length,), "<f2"),
            fine=None,
            model_sha256=model_sha256,
            packed=packed[form],
            form=form,
            forms=FORMS,
        )

    def vector(self, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """Make the vector of a uint8 image (H, W[, 3]): float32 (D,). Pixels where `mask` bool (H, W) is False must not
        count."""
        raise NotImplementedError

    def encode(self, image: np.ndarray, mask: np.ndarray | None = None) -> Descriptor:
        """Encode uint8 (H, W[, 3]) to coarse float16 (D,), of length 1 if the similarity is the cosine. A vector that
        is all zeros in half precision has quality 0. Raises ModelError for numbers beyond half precision."""
        vector = self.vector(image, mask)
        length = float(np.linalg.norm(vector))
        if self._similarity == "cosine":
            vector = vector / max(length, _TINY)
        if not np.abs(vector).max() <= np.finfo(np.float16).max:
            raise ModelError(
                f"{self.spec.name}: its vector has numbers beyond half precision ({np.abs(vector).max():.3g}): scale "
                "what the network puts out, or compare by cosine."
            )
        coarse = vector.astype("<f2")
        return Descriptor(coarse=coarse, quality=float(coarse.any()))

    def pack(self, coarse: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Make the rows of the index in 8 or 1 bit: coarse float16 (N, D), the map's mean (D,) to (N, *row shape)."""
        rows = np.zeros((len(coarse), *self.spec.row.shape), self.spec.row.dtype)
        for block in _blocks(len(coarse), self._length):
            left = coarse[block].astype(np.float32)
            left -= mean
            if self.spec.form == "1bit":
                rows[block, : -(-self._length // 8)] = np.packbits(left > 0, axis=1)
                continue
            step = np.maximum(np.abs(left).max(axis=1), np.finfo(np.float32).tiny) / 127
            whole = np.rint(np.divide(left, step[:, None], out=left), out=left)
            length = step * np.sqrt(np.einsum("nd,nd->n", whole, whole))
            rows[block, : self._length] = whole
            rows[block, self._length :] = np.stack([step, length], axis=1).astype("<f4").view(np.int8)
        return rows

    def coarse_scores(
        self,
        query: Descriptor,
        rows: np.ndarray,
        mean: np.ndarray | None = None,
        turned_deg: np.ndarray | None = None,
        height_ratio: float | None = None,
    ) -> tuple[np.ndarray, None]:
        """Compare a query with all places: `rows` (N, *row shape) and the map's mean (D,), unless the form is `float`,
        to scores float32 (N,), all 0 for a query of zeros. `turned_deg` and
        `height_ratio` are ignored: these vectors know neither."""
        asked = query.coarse.astype(np.float32)
        if not asked.any():  # less the mean, zeros would resemble some place, and equal another picture of zeros
            return np.zeros(len(rows), np.float32), None
        if self.spec.form == "1bit":
            code = np.zeros(self.spec.row.shape, np.uint8)
            code[: -(-self._length // 8)] = np.packbits(asked > mean)
            return (1 - hamming(code, rows) / np.float32(self._length)).astype(np.float32, copy=False), None
        if self.spec.form == "8bit":
            asked -= mean
        scores = np.empty(len(rows), np.float32)
        values = None
        for block in _blocks(len(rows), self._length):
            part = rows[block]
            if values is None:
                values = np.empty((len(part), self._length), np.float32)
            np.copyto(values[: len(part)], part[:, : self._length])
            beside = part[:, self._length :]
            step, length = np.ascontiguousarray(beside).view("<f4").T if beside.size else (None, None)
            scores[block] = self._compared(asked, values[: len(part)], step, length)
        return scores, None

    def _compared(
        self, asked: np.ndarray, values: np.ndarray, step: np.ndarray | None, length: np.ndarray | None
    ) -> np.ndarray:
        """Score some places. In 8 bits a place is `values` times `step`, less the mean as `asked` is, and its length is
        `length`. `values` is overwritten."""
        if self._similarity == "cosine":
            cosines = values @ asked
            if step is None:
                return np.clip(cosines, 0, 1, out=cosines)
            cosines *= step
            cosines /= np.maximum(length * np.linalg.norm(asked), np.finfo(np.float32).tiny)
            return np.clip((1 + cosines) / 2, 0, 1)
        if step is not None:
            values *= step[:, None]
        values -= asked
        if self._similarity == "l1":
            return 1 / (1 + np.abs(values, out=values).sum(axis=1))
        return 1 / (1 + np.sqrt(np.einsum("nd,nd->n", values, values)))


def _blocks(count: int, length: int) -> list[slice]:
    at_once = max(_BYTES_AT_ONCE // (4 * length), _FEWEST_AT_ONCE)
    return [slice(start, min(start + at_once, count)) for start in range(0, count, at_once)]
