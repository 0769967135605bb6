"""Figure 6.8 of the thesis: CoHOG with other GT, W1 and W2, and with the best G regions instead of the good ones.

The steps are those that `cohog` is made of, put together here for any size of picture and region: its map wants more
than twelve regions a side. A place keeps its regions in full, and not in 8 bits.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from edgevpr.core.text import progress
from edgevpr.frames.images import read_image
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.lab.evaluate.metrics import figures
from edgevpr.techniques.displacement import share
from edgevpr.techniques.entropy import block_means, filled_bins, good_blocks, shannon
from edgevpr.techniques.gradients import grey_square, levels, normalised_blocks, oriented_cells, slow_patterns

W1, W2, BINS, GT = 512, 16, 8, 0.5  # thesis 6.3.2
THESIS, VOTE = "mean of cosines (6.2.3)", "displacement vote"
GT_STEPS = tuple(round(0.1 * step, 1) for step in range(9))
TOP_G = (200, 400, 800)
W1_PX = (128, 256, 384, 512, 640)
W2_PX = (16, 32, 64, 128)
SAME_RATIO = ((256, 8), (384, 12), (512, 16), (640, 20), (768, 24))
_ENTROPY = {"filled_bins": filled_bins, "shannon": shannon}
_VOTES_COUNT = (1.0, 1.0, 0.75, 0.5)  # as `cohog` counts them, looking ahead


@dataclass(frozen=True, slots=True)
class Regions:
    """The blocks of a picture as they are compared, float32 (M, 4 L) and their slow patterns (M, P), and the mean
    entropy of each, float32 (M,), by its name."""

    blocks: np.ndarray
    patterns: np.ndarray
    entropy: dict[str, np.ndarray]


@dataclass(frozen=True, slots=True)
class Compared:
    """A query held against all references: for each (R) and each of its regions (M) the best cosine, float32 (R, M),
    and the most similar region by patterns, int (R, M)."""

    cosine: np.ndarray
    nearest: np.ndarray
    entropy: dict[str, np.ndarray]


@dataclass(frozen=True, slots=True)
class Selection:
    """A way to choose the regions that a query asks with: `of` gives their numbers, int (G,)."""

    label: str
    gt: float | None
    of: Callable[[Compared], np.ndarray]


def sweep(dataset: Dataset) -> list[dict]:
    """Run all four sweeps and the best G; minutes. A point says which of the sweeps it is of, its parameters, and by
    which score; `regions` is the mean number of regions a query asks with, `t_encode_s` the median CPU time of encoding
    one by `filled_bins` and GT 0.5, on one thread."""
    points = []
    good = at_least("filled_bins", GT)
    for size in dict.fromkeys([(W1, W2), *((w1, W2) for w1 in W1_PX), *((W1, w2) for w2 in W2_PX), *SAME_RATIO]):
        compared, t_encode_s = compare_all(dataset, *size), encode_s(dataset, *size)
        w1, w2 = size
        asked = []
        if size == (W1, W2):
            asked += [("GT", at_least(entropy, gt)) for entropy in _ENTROPY for gt in GT_STEPS]
            asked += [("best G", best_of(count)) for count in TOP_G]
        asked += [("W1", good)] if w2 == W2 and w1 in W1_PX else []
        asked += [("W2", good)] if w1 == W1 and w2 in W2_PX else []
        asked += [("W1/W2", good)] if size in SAME_RATIO else []
        for name, selection in asked:
            row = {"sweep": name, "w1": w1, "w2": w2, "chosen": selection.label, "gt": selection.gt}
            points += [{**row, "t_encode_s": t_encode_s, **found} for found in measure(dataset, compared, selection)]
    return points


def regions_of(image: np.ndarray, w1: int, w2: int) -> Regions:
    """Compute the regions of a picture, uint8 (H, W[, 3]), laid on W1 x W1 pixels in regions of W2 x W2."""
    grey = grey_square(image, w1)
    blocks = normalised_blocks(oriented_cells(grey, w2, BINS, signed=True)).reshape(-1, 4 * BINS)
    patterns = blocks @ slow_patterns(BINS)
    patterns /= np.maximum(np.linalg.norm(patterns, axis=1, keepdims=True), 1e-6)
    entropy = {name: block_means(of(levels(grey)), w2).ravel() for name, of in _ENTROPY.items()}
    return Regions(blocks, patterns, entropy)


def compare_all(dataset: Dataset, w1: int, w2: int) -> list[Compared]:
    """Hold all queries against all references."""
    places = [regions_of(read_image(dataset.ref_dir / name), w1, w2) for name in dataset.references]
    compared = []
    for query in progress(dataset.queries, len(dataset.queries), f"sweep, W1 {w1}, W2 {w2}"):
        asked = regions_of(read_image(query.path), w1, w2)
        compared.append(compared_of(asked, places))
    return compared


def compared_of(asked: Regions, places: Iterable[Regions]) -> Compared:
    """Hold one query against places: matrices C of 6.2.3, of which the largest of each row is kept."""
    cosine = [(asked.blocks @ place.blocks.T).max(axis=1) for place in places]
    nearest = [(asked.patterns @ place.patterns.T).argmax(axis=1) for place in places]
    return Compared(np.array(cosine), np.array(nearest), asked.entropy)


def at_least(entropy: str, gt: float) -> Selection:
    """Choose the good regions: those of so much entropy."""
    return Selection(entropy, gt, lambda compared: np.flatnonzero(compared.entropy[entropy] >= gt))


def best_of(count: int) -> Selection:
    """Choose the `count` regions of the largest entropy (Top-G of table 6.1)."""
    return Selection(
        f"best {count}",
        None,
        lambda compared: np.sort(np.argsort(-compared.entropy["filled_bins"], kind="stable")[:count]),
    )


def scores_of(compared: Compared, chosen: np.ndarray) -> dict[str, np.ndarray]:
    """Score all references, float (R,), by both scores; a query without a region scores 0."""
    if not len(chosen):
        nothing = np.zeros(len(compared.cosine))
        return {THESIS: nothing, VOTE: nothing}
    side = round(compared.cosine.shape[1] ** 0.5)
    votes = [share(chosen, nearest[chosen], (side, side), _VOTES_COUNT) for nearest in compared.nearest]
    return {THESIS: compared.cosine[:, chosen].mean(axis=1), VOTE: np.array(votes)}


def encode_s(dataset: Dataset, w1: int, w2: int) -> float:
    """Return the median CPU time of one query's encoding as `cohog` does it, one thread."""
    taken = []
    for query in dataset.queries:
        image = read_image(query.path)
        start = time.thread_time()
        grey = grey_square(image, w1)
        normalised_blocks(oriented_cells(grey, w2, BINS, signed=True))
        good_blocks(levels(grey), "filled_bins", w2, GT)
        taken.append(time.thread_time() - start)
    return float(np.median(taken))


def measure(dataset: Dataset, compared: list[Compared], selection: Selection) -> Iterator[dict]:
    """Yield what each score makes of all queries: the fields of a point that are measured."""
    chosen = [selection.of(each) for each in compared]
    scores = [scores_of(each, which) for each, which in zip(compared, chosen, strict=True)]
    right = [np.array([name in query.right for name in dataset.references]) for query in dataset.queries]
    for score in (THESIS, VOTE):
        ranked = [np.argsort(-each[score], kind="stable") for each in scores]
        ranks = np.array([metrics.first_right(order, of) for order, of in zip(ranked, right, strict=True)])
        found = figures(np.array([each[score].max() for each in scores]), ranks)
        yield {
            "score": score,
            "regions": float(np.mean([len(which) for which in chosen])),
            **{name: found[name] for name in ("recall_at_1", "precision_at_100_recall", "auc")},
        }
