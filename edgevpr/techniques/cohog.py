"""`cohog`: HOG descriptors of the informative regions of an image, matched by one matrix product (thesis, chapter 6).

A place is 31x31 overlapping blocks, also called regions, each described by the histograms of its 2x2 cells. A query
uses only its *good* blocks, those of high entropy. Each of them is matched to its most similar block of the place. In
the thesis the score is the mean of their cosines (`matching: thesis`). Here, by default, each good block also votes for
a displacement of the image. docs/explanation/how-cohog-matches.md explains every step of the score.

The blocks are the fine part: 8 bits per value, 31 KB per place, on disk. The coarse part stays in RAM and selects the
places that are compared in full (see `placecode` and, for a nadir camera, which looks straight down, `layout`)."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from edgevpr.core.arrays import Array, Bools, Bytes, Doubles, Image, Ints, Mask, Singles
from edgevpr.core.contract import (
    Descriptor,
    FineMatch,
    PartSpec,
    Perspective,
    Picture,
    TechniqueSpec,
    find_nearest_height,
)
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import wrap_deg
from edgevpr.techniques import cohog_tuning as tuning
from edgevpr.techniques import displacement, gradients, layout, overlay, placecode
from edgevpr.techniques.contrast import stretch_contrast
from edgevpr.techniques.entropy import average_blocks, find_good_blocks
from edgevpr.techniques.layout import ROTATIONS
from edgevpr.techniques.perspective import fit_perspective
from edgevpr.techniques.views import HEIGHT_RATIOS, QueryViews, ViewRegions, compute_scale, decode_hypothesis


@dataclass(eq=False, kw_only=True)
class CoHog:
    """The technique CoHOG. `w1`: side of the scaled image in pixels (W1 = H1 of the thesis). `w2`: that of a cell (W2 =
    H2). `bins`: orientations (L). `gt`: minimum entropy of a good block, 0 to 1 (GT; below 0: the default for
    `entropy`). `entropy`: "shannon" or "filled_bins". `matching`: "displacement" or "thesis", not recorded in the map.

    With `camera` "nadir" the image is padded to a square, not stretched, so a rotated image shows the same ground. A
    query has several hypotheses: five heights (one if `matching` is "thesis") with 24 rotations each (`views`)."""

    w1: int = 512
    w2: int = 16
    bins: int = 8
    gt: float = -1.0
    entropy: str = "shannon"
    camera: str = "forward"
    matching: str = "displacement"

    def __post_init__(self) -> None:
        self._require_parameters()
        if self.gt < 0:
            self.gt = tuning.DEFAULT_GT[self.entropy]
        self._side = self.w1 // self.w2 - 1  # blocks along one side
        self._is_nadir, self._votes = self.camera == "nadir", self.matching == "displacement"
        finds_height = self._is_nadir and self._votes  # the thesis's score cannot distinguish heights
        self.min_score, self.min_margin = tuning.ACCEPT_LIMITS[self.camera if self._votes else "thesis"]
        self.min_quality = tuning.MIN_QUALITY[self.entropy]
        self.candidates = tuning.CANDIDATES[self.camera]
        unchanged = HEIGHT_RATIOS.index(1.0) * ROTATIONS
        self._hypotheses = range(unchanged, unchanged + (ROTATIONS if self._is_nadir else 1))
        if finds_height:
            self._hypotheses = range(len(HEIGHT_RATIOS) * ROTATIONS)
        # Converts blocks, float32 (N, 4 bins), to the vectors of length 1 that `matching` compares.
        self._make_vectors: Callable[[Singles], Singles] = (
            self._make_patterns if self._votes else gradients.normalise_rows
        )
        self._query: Descriptor | None = None
        self._views: QueryViews | None = None
        code = PartSpec((placecode.SIDE, placecode.SIDE, self.bins), "|u1")
        self.spec = TechniqueSpec(
            name="cohog",
            parameters={key: getattr(self, key) for key in ("w1", "w2", "bins", "gt", "entropy", "camera")},
            coarse=PartSpec((layout.PLACE_BYTES,), "|u1") if self._is_nadir else code,
            fine=PartSpec((self._side**2, 4 * self.bins), "|u1"),
            packed=None if self._is_nadir else PartSpec((placecode.SIDE**2 * self.bins // 8,), "|u1"),
            scan_counts=self._votes and not self._is_nadir,
            heading_within_deg=tuning.MAX_HEADING_OFF_DEG if self._is_nadir else None,
            cells=self.w1 // self.w2 if self._votes else None,
            looks_down=finds_height,
            height_ratios=HEIGHT_RATIOS if finds_height else (),
            max_matches=tuning.MAX_MATCHES[self.camera] if self._votes else None,
        )

    def _require_parameters(self) -> None:
        allowed: dict[str, Collection[str]] = {
            "entropy": tuning.DEFAULT_GT,
            "camera": tuning.VOTE_WEIGHTS,
            "matching": tuning.MATCHINGS,
        }
        for name, values in allowed.items():
            if (value := getattr(self, name)) not in values:
                raise UsageError(f"cohog has no {name} `{value}`: use {' or '.join(sorted(values))}.")
        w1, w2, bins = self.w1, self.w2, self.bins
        if not (w2 >= 2 and w1 % w2 == 0 and w1 // w2 > placecode.SIDE and w1 <= 4096 and 2 <= bins <= 64):
            raise UsageError(
                f"cohog cannot use w1={w1}, w2={w2}, bins={bins}: w1, the side of the image, must be a multiple of w2, "
                f"the side of a region, at most 4096 pixels, and more than {placecode.SIDE} regions; w2 must be at "
                "least 2 pixels, and bins 2 to 64."
            )
        if self.camera == "nadir" and bins != tuning.NADIR_BINS:
            raise UsageError(f"cohog with `camera` nadir uses {tuning.NADIR_BINS} bins, not {bins}: omit `bins`.")
        if self.gt > 1:
            raise UsageError(f"cohog: gt is {self.gt:g}, but must be a fraction of the largest entropy, 0 to 1.")

    def encode(self, image: Image, mask: Mask | None = None) -> Descriptor:
        """Encode uint8 (H, W[, 3]); a block that contains a pixel where `mask` bool (H, W) is False is never good. The
        contrast of a dim image is stretched first (see `contrast`).

        Returns coarse uint8 (12, 12, bins), or uint8 (1120,) with a nadir camera, fine uint8 (blocks, 4 bins), regions
        float32 (blocks, 4 bins) and good bool (blocks,): the rows of matrix A of thesis 6.2.3."""
        if self._is_nadir:
            image, mask = gradients.pad_to_square(image, mask)
        grey, allowed = gradients.make_grey_square(image, self.w1), gradients.make_mask_square(mask, self.w1)
        pixel_px = self.w1 / image.shape[1], self.w1 / image.shape[0]
        grey = stretch_contrast(grey, allowed, pixel_px, *tuning.CONTRAST[self.camera])
        blocks, seen = self._make_blocks(grey, allowed, self.w2)
        good = find_good_blocks(gradients.round_levels(grey), self.entropy, self.w2, self.gt, eligible=seen)
        regions = blocks.reshape(-1, 4 * self.bins)
        # Store square roots in 8 bits: most values are small, and square roots preserve their precision better.
        stored = np.rint(255 * np.sqrt(regions)).astype(np.uint8)
        if self._is_nadir:
            # In float64, so that the layout is rounded to the same values on every processor.
            coarse = layout.encode_place(self._make_patterns(regions.astype(np.float64)), good.ravel(), self._side)
        else:
            coarse = np.rint(255 * placecode.make_grid(blocks, seen, np.ones_like(seen))[0]).astype(np.uint8)
        quality = float(good.sum() / max(seen.sum(), 1))
        picture = Picture(grey if self._is_nadir else None, allowed, seen)
        return Descriptor(
            coarse=coarse, fine=stored, regions=regions, good=good.ravel(), quality=quality, picture=picture
        )

    def _encode_view(self, grey: Singles, allowed: Mask | None, cell_px: int) -> tuple[Singles, Bools]:
        """Encode a view (see `views.Encode`). Good blocks have only `allowed` pixels and at least the entropy `gt`."""
        blocks, seen = self._make_blocks(grey, allowed, cell_px)
        return blocks, find_good_blocks(gradients.round_levels(grey), self.entropy, cell_px, self.gt, eligible=seen)

    def _make_blocks(self, grey: Singles, allowed: Mask | None, cell_px: int) -> tuple[Singles, Bools]:
        """Return a square image's blocks, float32 (n, n, 4 bins), and bool (n, n), True for fully `allowed` ones."""
        histograms = gradients.compute_histograms(grey, cell_px, self.bins, signed=True, allowed=allowed)
        blocks = gradients.normalise_blocks(histograms)
        if allowed is None:
            return blocks, np.ones(blocks.shape[:2], bool)
        return blocks, average_blocks(allowed.astype(np.float32), cell_px) >= 1.0

    def pack(self, coarse: Bytes, mean: Singles) -> Bytes:
        """Make the rows of the index in RAM, uint8 (N, B), from the coarse parts of N places, uint8 (N, 12, 12, bins),
        and the map's mean (12, 12, bins)."""
        return placecode.pack_grids(coarse.astype(np.float32) / 255, mean / 255)

    def score_places(
        self,
        query: Descriptor,
        rows: Array,
        mean: Singles | None,
        rotation_deg: Doubles | None = None,
        height_ratio: float | None = None,
        in_reach: Bools | None = None,
    ) -> tuple[Singles, Singles | None]:
        """Score all places; for the arguments, see `Technique.score_places`. With a forward camera `rows` are place
        codes uint8 (N, B), compared under shifts. With a nadir camera they are layouts uint8 (N, 1120), compared at the
        one of five heights that is nearest to `height_ratio`. Returns scores float32 (N,) in 0..1 and, with a nadir
        camera, the score of each hypothesis, float32 (N, 120): 24 rotations at each height, -inf if not tried."""
        if not self._is_nadir:
            views = self._make_views(query)
            mean_grid = np.zeros(1, np.float32) if mean is None else mean / 255
            grid = placecode.make_grid(views.make_blocks(1.0, 0)[0], views.seen, views.seen)
            signs = placecode.make_hypotheses(*grid, mean_grid)
            return np.clip(placecode.scan_in_two_steps(signs, rows), 0, 1), None
        ratio = find_nearest_height(HEIGHT_RATIOS, height_ratio or 1.0)
        self._make_views(query).discard_other_heights(ratio)
        first = HEIGHT_RATIOS.index(ratio) * ROTATIONS
        ratio_scores = layout.scan_places(
            lambda turn, grid: self._make_field(query, first + turn, grid), rows, rotation_deg, in_reach
        )
        scores = np.full((len(rows), len(HEIGHT_RATIOS) * ROTATIONS), -np.inf, np.float32)
        scores[:, first : first + ROTATIONS] = ratio_scores
        return np.clip(ratio_scores.max(axis=1), 0, 1), scores

    def _make_field(self, query: Descriptor, number: int, grid: layout.Grid) -> Singles:
        """Return the layout of a query under the hypothesis `number`, (C, m, m), cached for the latest query."""
        fields = self._make_views(query).fields
        if (number, grid.side) not in fields:
            view = self._make_views(query).make_regions(number, self._make_patterns)
            fields[number, grid.side] = layout.make_field(grid, view.regions, view.indices, (view.side, self._side))
        return fields[number, grid.side]

    def match(self, query: Descriptor, fine: Bytes, hypotheses: Sequence[int] | None = None) -> FineMatch:
        """Compare the query with a place, whose blocks are `fine`: compute C = A B^T (thesis 6.2.3), where A are the
        good regions of the query and B those of the place, then the score according to `matching` (0 without a good
        region). A nadir query is compared under `hypotheses` (None: all); `fit_alignment` refines shift, rotation and
        height of the one with the highest score. Finally, the score is reduced if the structures of the two images
        agree poorly (see `overlay`)."""
        reference = self._restore_regions(fine)
        if self._is_nadir:
            best, match, nearest = self._find_best_hypothesis(query, reference, hypotheses)
            if self._votes:
                view = self._make_view(query, best)
                match = displacement.fit_alignment((view.indices, view.side), (nearest, self._side), match)
        else:
            match, _ = self._match_view(self._make_view(query, self._hypotheses[0]), reference)
        if match.shift_cells is None:
            return match
        agreement = self._measure_agreement(query, reference, match)
        min_agreement, max_agreement = tuning.STRUCTURE_LIMITS[self.camera]
        factor = min(max(agreement, min_agreement), max_agreement) / max_agreement
        return replace(match, score=match.score * factor, votes=match.score, structure=agreement)

    def match_rotated(self, query: Descriptor, fine: Bytes, match: FineMatch) -> FineMatch:
        """See `Technique.match_rotated`."""
        first = HEIGHT_RATIOS.index(find_nearest_height(HEIGHT_RATIOS, match.height_ratio or 1.0)) * ROTATIONS
        offset_deg = np.abs(wrap_deg(360 * np.arange(ROTATIONS) / ROTATIONS - (match.rotation_deg or 0.0)))
        return self.match(query, fine, (first + np.flatnonzero(offset_deg >= tuning.MIN_ROTATED_DEG)).tolist())

    def measure_perspective(self, query: Descriptor, fine: Bytes, match: FineMatch) -> Perspective | None:
        """See `Technique.measure_perspective`."""
        ratio, step_deg = find_nearest_height(HEIGHT_RATIOS, match.height_ratio or 1.0), 360 / ROTATIONS
        turn = round((match.rotation_deg or 0.0) / step_deg) % ROTATIONS
        view = self._make_view(query, HEIGHT_RATIOS.index(ratio) * ROTATIONS + turn)
        nearest = displacement.find_most_similar(view.regions, self._restore_regions(fine))
        scale, offset_deg = compute_scale(self._side + 1, ratio), (match.rotation_deg or 0.0) - turn * step_deg
        fit = fit_perspective(
            displacement.locate_regions(view.indices, view.side),
            displacement.locate_regions(nearest, self._side),
            complex((match.height_ratio or 1.0) / scale * np.exp(1j * np.radians(offset_deg))),
            complex(*(match.shift_cells or (0.0, 0.0))),
        )
        if fit is None:
            return None
        place_from_view, sd, regions = fit
        cells, turn_rad = (self._side + 1) * scale, np.radians(turn * step_deg)
        view_from_query = cells * np.exp(1j * turn_rad)
        right, down = view_from_query.real, view_from_query.imag
        place_from_query = place_from_view @ [[right, -down, 0], [down, right, 0], [0, 0, 1]]
        place_from_query[:2] /= self._side + 1
        return Perspective(place_from_query, cells * sd, regions)

    def match_at_rest(self, query: Descriptor, fine: Bytes) -> FineMatch:
        """See `Technique.match_at_rest`: compare only at the place's own height and heading."""
        return self._find_best_hypothesis(query, self._restore_regions(fine), [HEIGHT_RATIOS.index(1.0) * ROTATIONS])[1]

    def _find_best_hypothesis(
        self, query: Descriptor, reference: Singles, hypotheses: Sequence[int] | None
    ) -> tuple[int, FineMatch, Ints]:
        """Compare a nadir query with a place under `hypotheses` (None: all). Returns the number of the hypothesis with
        the highest score, its match, and for each region of this view the most similar region of the place."""
        place = None
        if self._votes:
            indices = np.flatnonzero(reference.any(axis=1))
            place = layout.make_field(layout.FINE, reference[indices], indices, (self._side, self._side))
        matches, nearest = dict[int, FineMatch](), dict[int, Ints]()
        for number in self._hypotheses if hypotheses is None else hypotheses:
            match, nearest[number] = self._match_view(self._make_view(query, number), reference)
            if place is not None and match.shift_cells is not None:
                shift = match.shift_cells[0] / self._side, match.shift_cells[1] / self._side
                agreement = layout.compute_agreement(self._make_field(query, number, layout.FINE), place, shift)
                match = replace(match, score=min(1.0, match.score * agreement / tuning.FULL_LAYOUT_AGREEMENT))
            matches[number] = match
        best = max(matches, key=lambda number: matches[number].score)
        ratio, turn = decode_hypothesis(best)
        scale = compute_scale(self._side + 1, ratio)
        return best, replace(matches[best], rotation_deg=360 * turn / ROTATIONS, height_ratio=scale), nearest[best]

    def _measure_agreement(self, query: Descriptor, reference: Singles, match: FineMatch) -> float:
        """Overlay a query on a place according to their `match` (see `overlay`); `reference`: regions of the place.
        Returns the agreement of their structures or, with a nadir camera, its prominence."""
        views, cells = self._make_views(query), self._side + 1
        is_known = reference.any(axis=1).reshape(self._side, self._side)
        place = overlay.compute_structure(reference, is_known, tuning.SURROUND_SD_CELLS[self.camera])
        if self._is_nadir:
            warped = overlay.overlay_query(*views.halved, match, cells)
            structure = self._make_structure(*self._make_blocks(*warped, len(warped[0]) // cells))
            return overlay.measure_prominence(structure, place)
        if views.structure is None:
            views.structure = self._make_structure(views.make_blocks(1.0, 0)[0], views.seen)
        return overlay.compute_agreement(views.structure, place, match.shift_cells or (0.0, 0.0))

    def _make_structure(self, blocks: Singles, seen: Bools) -> Singles:
        """Return the structure (see `overlay`) of the image with these blocks, float32 (n, n, 4 bins)."""
        patterns = self._make_patterns(blocks.reshape(-1, 4 * self.bins))
        return overlay.compute_structure(patterns, seen, tuning.SURROUND_SD_CELLS[self.camera])

    def score_quickly(
        self, query: Descriptor, fine: Bytes, hypotheses: Sequence[int] | None = None
    ) -> tuple[float, list[int] | None]:
        """Estimate the score of `match`: with a forward camera from a quarter of the good regions, with a nadir camera
        from the vote and the layouts. See `Technique.score_quickly`."""
        reference = self._restore_regions(fine)
        if self._is_nadir:
            best, match, _ = self._find_best_hypothesis(query, reference, hypotheses)
            return match.score, [best]
        view = self._make_view(query, self._hypotheses[0])
        nearest = displacement.find_most_similar(view.regions[:: tuning.QUICK_STEP], reference)
        return displacement.compute_vote_fraction(
            view.indices[:: tuning.QUICK_STEP], nearest, (view.side, self._side), tuning.VOTE_WEIGHTS[self.camera]
        ), None

    def _restore_regions(self, fine: Bytes) -> Singles:
        """Restore the vectors to compare from the `fine` part of a place, which stores the square roots of blocks."""
        return self._make_vectors(np.square(fine, dtype=np.float32))

    def _make_view(self, query: Descriptor, number: int) -> ViewRegions:
        """Return the good regions of a query under the hypothesis `number`."""
        return self._make_views(query).make_regions(number, self._make_vectors)

    def _make_views(self, query: Descriptor) -> QueryViews:
        """Return the rotated and scaled views of `query`, cached for the latest query."""
        if query is not self._query or self._views is None:
            if query.regions is None or query.good is None or query.picture is None:
                raise ValueError("a place that was read from a map cannot be a query")
            unchanged = query.regions.reshape(self._side, self._side, -1), query.good.reshape(self._side, -1)
            self._views = QueryViews(query.picture, unchanged, self.w2, self._encode_view)
            self._query = query
        return self._views

    def _make_patterns(self, regions: Singles) -> Singles:
        """Reduce regions, float32 (N, 4 bins), to patterns (N, patterns) of length 1 (see `make_slow_patterns`)."""
        return gradients.normalise_rows(regions @ gradients.make_slow_patterns(self.bins))

    def _match_view(self, view: ViewRegions, reference: Singles) -> tuple[FineMatch, Ints]:
        if self._votes:  # with a nadir camera, landmarks are better evidence than the support of all regions
            weight = tuning.VOTE_WEIGHTS[self.camera]
            return displacement.match_view(view, reference, weight, with_support=not self._is_nadir)
        similarities = view.regions @ reference.T
        nearest = similarities.argmax(axis=1)
        score = np.clip(similarities[np.arange(len(nearest)), nearest].mean(), 0, 1) if len(nearest) else 0
        return FineMatch(float(score)), nearest
