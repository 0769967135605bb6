"""`cohog`: HOG descriptors of the informative regions of a picture, matched by one product (thesis, chapter 6).

A place is 31x31 overlapping blocks, each described by the histograms of its 2x2 cells. A query uses only its *good*
blocks, those of high entropy. Each of them finds its most similar block in the reference. In the thesis the score is
the mean of these cosines (`matching: thesis`). Here, by default, each good block also votes for the displacement of the
picture, and the score is the share of votes that agree (`matching: displacement`, see `displacement`). With a forward
camera the score of the scan counts too.

The blocks are the fine part: 8 bits per value, 31 KB per place, on disk. The coarse part stays in RAM and selects the
places that are compared in full. Ahead it is the same blocks averaged over a grid, in 144 bytes (see `placecode`);
looking down it is a hundred words, in 200 (see `placewords`).
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from edgevpr.core.contract import Descriptor, FineMatch, PartSpec, Picture, TechniqueSpec, nearest_height
from edgevpr.core.errors import UsageError
from edgevpr.techniques import placecode, placewords
from edgevpr.techniques.alignment import align
from edgevpr.techniques.displacement import displacement, share, support
from edgevpr.techniques.entropy import block_means, good_blocks
from edgevpr.techniques.gradients import grey_square, levels, mask_square, normalised_blocks, oriented_cells
from edgevpr.techniques.patterns import slow_patterns
from edgevpr.techniques.views import (
    HEIGHT_RATIOS,
    ROTATIONS,
    WITHIN_QUARTER,
    Asking,
    Views,
    cells_along,
    hypothesis,
)

# The goodness threshold GT of the thesis (6.3.2) and of the authors' public code, each for its own entropy.
_DEFAULT_GT = {"filled_bins": 0.5, "shannon": 0.4}
# Weight of a vote that is 0, 1, 2 ... cells off the peak. With a forward camera, near and far ground move by different
# steps; with a nadir camera (one that looks straight down) the step is known more exactly.
_VOTES_COUNT = {"forward": (1.0, 1.0, 0.75, 0.5), "nadir": (1.0, 1.0)}
# (min_score, min_margin). Displacement vote: no wrong match on corridor (forward; single queries, or sequences of ten)
# or on aerial_caliterra (nadir) reached both values, nor did any query of two other sites in the map of
# aerial_caliterra. The thesis's score has no safe threshold: its margin rejects those queries of other sites, and most
# right matches too.
_ACCEPT = {"forward": (0.07, 0.035), "nadir": (0.08, 0.03), "thesis": (0.0, 0.02)}
# Least quality. Without it, the pictures of nothing that were accepted on the tuning sets had .39 or less, and real
# ones, washed out or covered, that were taken for a wrong place .43 or less; right matches had .91 or more (on the
# other sets .72, and .47 where pictures have 64 x 32 pixels). With `filled_bins` it was .14, .18 and .30.
_MIN_QUALITY = {"shannon": 0.4, "filled_bins": 0.2}
_CANDIDATES = {"forward": 42, "nadir": 50}
# Places compared in full, those that look best at a glance. On corridor, the seasons and nordland_tiny 12 of 42, and on
# all aerial sets and the kite joined into one map 20 of 300 pairs, find as many places as all of them compared in full
# (of the 994 of nordland_tiny four fewer).
_IN_FULL = {"forward": 12, "nadir": 20}
_VOTING_BESIDE = 0.4  # part of the pairs of places and rotations that vote, from another height than the map's
_HEADING_WITHIN_DEG = 1.5 * 360 / ROTATIONS  # the expected rotation, and one on either side


class CoHog:
    """CoHOG. Parameters of the thesis: W1 = H1 is `w1` (pixels), W2 = H2 is `w2` (pixels), L is `bins`, GT is `gt`
    (below 0: the default for the entropy). `entropy` is "shannon" or "filled_bins".

    With `camera` "nadir" the picture is laid into a square with its shape kept, so that a rotated picture shows the
    same ground, and a query is tried from five heights (with "thesis" from one) in 24 rotations; places are named by
    `words` (see `placewords.load`). The map records `camera` and `words`. It does not record `matching`, "displacement"
    or "thesis": both read the same map.
    """

    def __init__(
        self,
        *,
        w1: int = 512,
        w2: int = 16,
        bins: int = 8,
        gt: float = -1.0,
        entropy: str = "shannon",
        camera: str = "forward",
        matching: str = "displacement",
        words: str = "ground_words",
    ) -> None:
        _require("entropy", entropy, _DEFAULT_GT)
        _require("camera", camera, _VOTES_COUNT)
        _require("matching", matching, ("displacement", "thesis"))
        if not (w2 >= 2 and w1 % w2 == 0 and w1 // w2 > placecode.SIDE and w1 <= 4096 and 2 <= bins <= 64):
            raise UsageError(
                f"cohog cannot use w1={w1}, w2={w2}, bins={bins}: w1 must be a multiple of w2 (more than "
                f"{placecode.SIDE} regions of at least 2 pixels, at most 4096 pixels), bins 2 to 64."
            )
        if camera == "nadir" and bins != placewords.BINS:
            raise UsageError(f"cohog looking down uses {placewords.BINS} bins, which its words are of, and not {bins}.")
        if gt > 1:
            raise UsageError(f"cohog: gt is {gt:g}; it is a share of the largest entropy, 0 to 1.")
        self._w1, self._w2, self._bins = w1, w2, bins
        self._entropy, self._camera = entropy, camera
        self._gt = gt if gt >= 0 else _DEFAULT_GT[entropy]
        self._side = w1 // w2 - 1  # blocks along one side
        self._matched = self._displacement if matching == "displacement" else self._thesis
        self._compares_patterns = matching == "displacement"
        self.min_score, self.min_margin = _ACCEPT[camera if matching == "displacement" else matching]
        self.min_quality = _MIN_QUALITY[entropy]
        self.candidates = _CANDIDATES[camera]
        self._vocabulary = placewords.load(words) if camera == "nadir" else None
        # The thesis's score does not tell which of two heights is right.
        self._ratios = HEIGHT_RATIOS if self._compares_patterns else (1.0,)
        self._asked, self._views, self._asking_of = None, None, {}
        parameters = {"w1": w1, "w2": w2, "bins": bins, "gt": self._gt, "entropy": entropy, "camera": camera}
        if camera == "nadir":
            parameters["words"] = words
        self.spec = TechniqueSpec(
            name="cohog",
            parameters=parameters,
            coarse=PartSpec((placewords.SIDE**2,), placewords.DTYPE) if camera == "nadir" else _grid_spec(bins),
            fine=PartSpec((self._side**2, 4 * bins), "|u1"),
            packed=None if camera == "nadir" else PartSpec((placecode.SIDE**2 * bins // 8,), "|u1"),
            scan_counts=matching == "displacement" and camera == "forward",  # with a nadir camera it adds nothing
            heading_within_deg=_HEADING_WITHIN_DEG if camera == "nadir" else None,
            cells=w1 // w2 if camera == "nadir" and matching == "displacement" else None,
            height_ratios=self._ratios if camera == "nadir" and len(self._ratios) > 1 else (),
            in_full=_IN_FULL[camera] if matching == "displacement" else None,
        )

    def encode(self, image: np.ndarray, mask: np.ndarray | None = None) -> Descriptor:
        """Encode uint8 (H, W[, 3]); a block that touches a pixel where `mask` bool (H, W) is False is never good.

        Returns coarse uint8 (12, 12, bins), with a nadir camera uint16 (100,), fine uint8 (blocks, 4 bins) and, for a
        query, regions float32 (blocks, 4 bins) and good bool (blocks,): the good ones are the rows of matrix A of
        6.2.3.
        """
        if self._camera == "nadir":
            image, mask = _in_square(image, mask)
        grey, allowed = grey_square(image, self._w1), mask_square(mask, self._w1)
        blocks, seen, good = self._regions(grey, allowed, self._w2)
        regions = blocks.reshape(self.spec.fine.shape)
        # The square root of each value in 8 bits: most values are small, and the root keeps more of their digits.
        stored = np.rint(255 * np.sqrt(regions)).astype(np.uint8)
        if self._camera == "nadir":
            at = placewords.named(self._side)
            coarse = placewords.of_place(self._vocabulary, self._patterns(regions[at]), good.ravel()[at])
        else:
            coarse = np.rint(255 * placecode.grid(_middle(blocks, seen))).astype(np.uint8)
        quality = float(good.sum() / max(seen.sum(), 1))
        picture = Picture(grey if self._camera == "nadir" else None, allowed, seen)
        return Descriptor(
            coarse=coarse, fine=stored, regions=regions, good=good.ravel(), quality=quality, picture=picture
        )

    def _regions(
        self, grey: np.ndarray, allowed: np.ndarray | None, cell_px: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the blocks float32 (n, n, 4 bins) of cells of so many pixels. Also return, as bool (n, n), which of
        them are wholly allowed, and which of these are good."""
        blocks = normalised_blocks(oriented_cells(grey, cell_px, self._bins, signed=True, allowed=allowed))
        if allowed is None:
            seen = np.ones(blocks.shape[:2], bool)
        else:
            seen = block_means(allowed.astype(np.float32), cell_px) >= 1.0
        return blocks, seen, good_blocks(levels(grey), self._entropy, cell_px, self._gt, among=seen)

    def pack(self, coarse: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Make the rows of the index, uint8 (N, B), of coarse uint8 (N, 12, 12, bins) and the map's mean
        (12, 12, bins)."""
        return placecode.pack(coarse.astype(np.float32) / 255, mean / 255)

    def coarse_scores(
        self,
        query: Descriptor,
        rows: np.ndarray,
        mean: np.ndarray | None,
        turned_deg: np.ndarray | None = None,
        height_ratio: float | None = None,
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Compare the query with the place codes `rows`, uint8 (N, B), under shifts. With a nadir camera compare its
        words with those of the places, uint16 (N, 100), under all rotations or those within `spec.heading_within_deg`
        of `turned_deg` (N,), from the one of five heights that is nearest to `height_ratio`. Returns scores float32
        (N,) in 0..1 and, as float32 (N, 120), those of each hypothesis (None with a forward camera): 24 rotations from
        each height.
        """
        if self._camera == "forward":
            seen = query.picture.seen
            blocks = _middle(query.regions.reshape(self._side, self._side, -1), seen)
            asked = placecode.hypotheses(*placecode.seen_grid(blocks, _middle(seen, seen)), mean / 255)
            return np.clip(placecode.scan_ahead(asked, rows), 0, 1), None
        expected, needed = None, set(range(WITHIN_QUARTER))
        if turned_deg is not None:
            steps = np.rint(turned_deg * (ROTATIONS / 360)) % ROTATIONS
            expected = np.nan_to_num(steps, nan=-1).astype(np.intp)
            if len(expected) and expected.min() >= 0:
                needed = {int(turn) % WITHIN_QUARTER for near in (-1, 0, 1) for turn in np.unique(expected) + near}
        ratio = nearest_height(HEIGHT_RATIOS, height_ratio or 1.0)
        scores = np.full((len(rows), len(HEIGHT_RATIOS) * ROTATIONS), -np.inf, np.float32)
        asking = {turn: self.good_patterns(query, turn, ratio) for turn in sorted(needed)}
        sides = self._views_of(query).side_of(ratio), self._side
        asked = placewords.of_query(self._vocabulary, asking, WITHIN_QUARTER, sides)
        of_ratio = _columns(scores, ratio)
        of_ratio[:] = placewords.scan(asked, rows, expected, 1.0 if ratio == 1.0 else _VOTING_BESIDE)
        return np.clip(of_ratio.max(axis=1), 0, 1), scores

    def good_patterns(self, query: Descriptor, turn: int, ratio: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the slow patterns float32 (G, 20) of the good regions of a view of the query (see `views`),
        and their numbers int (G,) on its grid."""
        blocks, numbers = self._views_of(query).whole(ratio, turn)
        return self._patterns(blocks), numbers

    def match(self, query: Descriptor, fine: np.ndarray, hypotheses: Sequence[int] | None = None) -> FineMatch:
        """Compute C = A B^T (thesis 6.2.3), with A the good regions of the query and B those of the place, then the
        score by `matching`. A query without a good region scores 0. A nadir query is tried under `hypotheses` (None:
        all), and the best one counts, with shift, rotation and height as its agreeing regions lie (see `alignment`)."""
        reference = self._reference(fine)
        if self._camera == "forward":
            return self._matched(self._asking(query, 0), reference)
        matches = {each: self._matched(self._asking(query, each), reference) for each in self._tried(hypotheses)}
        best = max(matches, key=lambda each: matches[each].score)
        ratio, turn = hypothesis(best)
        ratio = cells_along(self._side + 1, ratio) / (self._side + 1)
        match = replace(matches[best], rotation_deg=360 * turn / ROTATIONS, height_ratio=ratio)
        if match.shift_cells is None or match.score < self.min_score:  # most are of other places: no need of the detail
            return match
        return self._aligned(match, self._asking(query, best), reference)

    def _aligned(self, match: FineMatch, asking: Asking, reference: np.ndarray) -> FineMatch:
        """Return a match by the vote with shift, rotation and height to a fraction of a step."""
        best = (asking.regions @ reference.T).argmax(axis=1)
        found = align((asking.numbers, asking.side), (best, self._side), match.shift_cells)
        if found is None:
            return match
        return replace(
            match,
            shift_cells=found.shift_cells,
            covariance_cells2=found.covariance_cells2,
            rotation_deg=(match.rotation_deg + found.turn_deg) % 360,
            height_ratio=match.height_ratio * found.scale,
        )

    def glance(
        self, query: Descriptor, fine: np.ndarray, hypotheses: Sequence[int] | None = None
    ) -> tuple[float, list[int] | None]:
        """Compare a part of the good regions with those of one place, as `match` does all of them: a quarter, or of a
        nadir query about as many from each height. Returns about the score and, with a nadir camera, the hypothesis
        under which the most agree."""
        reference = self._reference(fine)
        tried = (0,) if self._camera == "forward" else self._tried(hypotheses)
        scores = []
        for each in tried:
            asking = self._asking(query, each)
            numbers, regions = asking.numbers[:: asking.step], asking.regions[:: asking.step]
            nearest = (regions @ reference.T).argmax(axis=1)
            agree = share(numbers, nearest, (asking.side, self._side), _VOTES_COUNT[self._camera])
            scores.append(agree * asking.worth_at_glance)
        best = int(np.argmax(scores))
        return scores[best], None if self._camera == "forward" else [tried[best]]

    def _tried(self, hypotheses: Sequence[int] | None) -> Sequence[int]:
        if hypotheses is not None:
            return hypotheses
        first = HEIGHT_RATIOS.index(self._ratios[0]) * ROTATIONS
        return range(first, first + len(self._ratios) * ROTATIONS)

    def _reference(self, fine: np.ndarray) -> np.ndarray:
        """Return the fine part of a place as `_comparable` blocks: the stored values are square roots."""
        blocks = fine.astype(np.float32)
        blocks *= blocks
        return self._comparable(blocks)

    def _asking(self, query: Descriptor, number: int) -> Asking:
        """Return the good regions of a query under a hypothesis (with a forward camera: as it is). Those of the newest
        query are kept, since it is compared with many places."""
        views = self._views_of(query)
        if number not in self._asking_of:
            if views is None:
                regions = self._comparable(query.regions[query.good])
                asking = Asking(numbers=np.flatnonzero(query.good), regions=regions, side=self._side)
            else:
                asking = views.asking(*hypothesis(number), self._comparable)
            self._asking_of[number] = asking
        return self._asking_of[number]

    def _views_of(self, query: Descriptor) -> Views | None:
        if query is not self._asked:
            self._asked, self._views, self._asking_of = query, None, {}
            if self._camera == "nadir":
                square = (self._side, self._side)
                own = query.regions.reshape(*square, -1), query.good.reshape(square)
                self._views = Views(query.picture, own, self._w2, lambda *view: self._regions(*view)[::2])
        return self._views

    def _comparable(self, blocks: np.ndarray) -> np.ndarray:
        """Return blocks float32 (N, 4 bins), or for the displacement vote their slow patterns (N, patterns), each of
        length 1."""
        return self._patterns(blocks) if self._compares_patterns else _unit(blocks)

    def _patterns(self, regions: np.ndarray) -> np.ndarray:
        """Return regions float32 (N, 4 bins) as their slow patterns (N, patterns), each of length 1."""
        return _unit(regions @ slow_patterns(self._bins))

    def _thesis(self, asking: Asking, reference: np.ndarray) -> FineMatch:
        if not len(asking.numbers):
            return FineMatch(0.0)
        return FineMatch(float(np.clip((asking.regions @ reference.T).max(axis=1).mean(), 0, 1)))

    def _displacement(self, asking: Asking, reference: np.ndarray) -> FineMatch:
        best = (asking.regions @ reference.T).argmax(axis=1)
        found = displacement(asking.numbers, best, (asking.side, self._side), _VOTES_COUNT[self._camera])
        # Looking down, landmarks say more than the other regions do.
        asks_all = self._camera == "forward" and len(asking.numbers)
        return FineMatch(
            min(1.0, found.share * asking.worth),
            shift_cells=found.shift_cells,
            covariance_cells2=found.covariance_cells2,
            coverage=found.agreeing / len(reference),
            support=support(asking.numbers, asking.regions, reference, best, found.shift_cells) if asks_all else None,
        )


def _require(what: str, value: str, allowed) -> None:
    if value not in allowed:
        raise UsageError(f"cohog has no {what} `{value}`: use {' or '.join(sorted(allowed))}.")


def _grid_spec(bins: int) -> PartSpec:
    return PartSpec((placecode.SIDE, placecode.SIDE, bins), "|u1")


def _columns(scores: np.ndarray, ratio: float) -> np.ndarray:
    """Return the columns of scores (N, H) that are of one height ratio."""
    first = HEIGHT_RATIOS.index(ratio) * ROTATIONS
    return scores[:, first : first + ROTATIONS]


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(np.sqrt(np.einsum("ij,ij->i", rows, rows)), 1e-6)[:, None]


def _middle(per_block: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Cut out the largest square in the middle that the picture fills, if it was laid into a larger one:
    (side, side, ...) to (n, n, ...)."""
    n = max(min(int(seen.any(axis=0).sum()), int(seen.any(axis=1).sum())), placecode.SIDE)
    start = (len(seen) - n) // 2
    return per_block[start : start + n, start : start + n]


def _in_square(image: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Lay a picture into the middle of a square. Returns the square, and bool (side, side): part of the picture and
    allowed."""
    height, width = image.shape[:2]
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    border = top, side - height - top, left, side - width - left
    allowed = np.ones((height, width), bool) if mask is None else mask
    return (
        cv2.copyMakeBorder(image, *border, cv2.BORDER_REPLICATE),
        cv2.copyMakeBorder(allowed.astype(np.uint8), *border, cv2.BORDER_CONSTANT, value=0).astype(bool),
    )
