"""Techniques that make one vector of a picture: three forms of it in RAM, and how two are compared.

The map file keeps each vector in half precision. In RAM it is that (`float`), or, less the mean of the map, one byte
(`8bit`) or one bit (`1bit`) a number: what all places have in common says nothing of where one is, and takes most of
the range that a byte has. The mean changes while a map grows, which is why the file knows no form: one map serves all.
"""

from typing import ClassVar

import numpy as np

from edgevpr.config import FORMS
from edgevpr.contract import Descriptor, PartSpec, TechniqueSpec
from edgevpr.errors import ModelError, UsageError
from edgevpr.techniques.hamming import hamming

# Ahead by more than any match can be: how far ahead the wrong matches of a network are is known for the weights that
# edgevpr ships. With others none is accepted until the configuration says from when on.
NEVER = 2.0
_SHIPPED = "calc"
_TINY = 1e-6
_BYTES_AT_ONCE = 4 << 20  # of places turned to float32 together
_FEWEST_AT_ONCE = 16
_BESIDE_BYTES = 8  # of a row in 8 bits: its step and its length, both float32
_WORD_BITS = 64  # a row in 1 bit is filled up to whole words, which count faster


class VectorTechnique:
    """What a technique of one vector does beside making it: a subclass gives `vector`.

    `similarity` is "cosine", "l1" or "l2"; in 1 bit it is always Hamming's. All scores are 0 to 1: the cosine itself,
    below 0 as 0 (unrelated), for `float`; (1 + cosine) / 2 of what is left without the mean for `8bit`; 1 / (1 +
    distance) for both others; the share of equal bits for `1bit`. `accept` gives (min_score, min_margin) of a form
    where it is not that of the class; with another `model` than the one shipped, nothing is accepted.
    """

    candidates = 1  # there is no fine part to compare
    min_score = 0.0
    min_margin = 0.0
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
        """The vector of a uint8 image, float32 (D,); what lies where `mask` (H, W) is False must not count."""
        raise NotImplementedError

    def encode(self, image: np.ndarray, mask: np.ndarray | None = None) -> Descriptor:
        """Encode uint8 (H, W[, 3]) -> coarse float16 (D,), of length 1 where the similarity is the cosine. A vector of
        zeros, or of what half precision takes for such, has quality 0. Raises ModelError for numbers beyond half
        precision."""
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
        """Rows of the index in 8 or 1 bit: coarse float16 (N, D), the map's mean (D,) -> (N, *row shape)."""
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
    ) -> tuple[np.ndarray, None]:
        """Compare a query with all places: `rows` (N, *row shape), the map's mean (D,) unless the form is `float` ->
        scores float32 (N,), all 0 for a query of zeros. Nothing is known of rotations: `turned_deg` changes nothing."""
        asked = query.coarse.astype(np.float32)
        if not asked.any():  # less the mean it would be like some place, and another picture of nothing the very same
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
        """Scores of some places. In 8 bits the place is `values` times `step`, less the mean as `asked` is, and
        `length` long. `values` is overwritten."""
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
