"""Learns visual words by k-means from one's own pictures, for the techniques that count them:
`python models/recipes/train_words.py --images DIR... --kind vlad --count 64`.

The file MODEL_KIND<COUNT>.npz, which `edgevpr.techniques.words.load_words` reads, holds `words` float16 (K, D), rounded
to steps of 1/256 so that ten thousand of them take little room, and `model_sha256`, the fingerprint of the card whose
feature map they describe.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from training_pictures import read_pictures

from edgevpr.core.arrays import Image, Ints, Singles
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.files import list_model_folders
from edgevpr.core.text import progress
from edgevpr.frames.images import list_images
from edgevpr.techniques.regions import describe_regions, find_regions
from edgevpr.techniques.session import Backbone, open_backbone
from edgevpr.techniques.words import find_nearest, make_local_descriptors

REGIONS = {"regions": 400, "bow": 200}  # regions per picture, as in `region_vlad` and `cross_region_bow`
_POINTS = 60_000  # the fewest local descriptors to learn words from, if there are as many ...
_POINTS_PER_WORD = 12  # ... and the fewest per word
_ROUNDS = 10
_STEP = 256
_JUDGED = 5000  # of the points: enough to tell how well the words fit
_BLOCK_VALUES = 8_000_000  # distances held at once: 32 MB


def main(argv: Sequence[str] | None = None) -> None:
    """Learn the words that the arguments ask for, write their file, and print how well they fit."""
    parser = argparse.ArgumentParser(description="Learn the words that vlad, regions or bow count.")
    parser.add_argument("--images", required=True, nargs="+", metavar="DIR", help="folders of images")
    parser.add_argument("--model", default="calc", metavar="NAME", help="the card of the backbone (calc)")
    parser.add_argument("--kind", required=True, choices=("vlad", *REGIONS), help="what the words are of")
    parser.add_argument("--count", type=int, required=True, metavar="N", help="the number of words")
    parser.add_argument("--out", type=Path, default=list_model_folders()[0], metavar="DIR", help="(your models folder)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="(1)")
    args = parser.parse_args(argv)
    backbone, rng = open_backbone(args.model, "features"), np.random.default_rng(args.seed)
    points, pictures = _descriptors(args.images, backbone, args.kind, args.count, rng)
    if len(points) < 2 * args.count:
        raise UsageError(
            f"{pictures} usable images give {len(points)} descriptors: give more images, or at most {len(points) // 2} "
            "words (--count)."
        )
    *_, centres = progress(kmeans(points, args.count, _ROUNDS, rng), _ROUNDS, "learning")
    stored = (np.rint(centres * _STEP) / _STEP).astype(np.float16)
    words = stored.astype(np.float32)
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / f"{args.model}_{args.kind}{args.count}.npz"
    np.savez_compressed(path, words=stored, model_sha256=np.array(backbone.sha256))
    some = points[:: max(1, len(points) // _JUDGED)]
    distance = np.square(some - words[find_nearest(some, words)]).sum(axis=1).mean()
    print(
        f"{path}: learnt from {len(points)} descriptors of {pictures} images, whose mean square distance to their word "
        f"is {distance:.3f} (2: nothing in common)"
    )


def _descriptors(
    folders: Sequence[str], backbone: Backbone, kind: str, count: int, rng: np.random.Generator
) -> tuple[Singles, int]:
    """Collect descriptors of the pictures in `folders`, of each so many random ones that all give enough for `count`
    words. Returns them, float32 (N, D), and the number of pictures."""

    def described(picture: Image) -> Singles:
        features = backbone.run(picture)
        if kind == "vlad":
            return make_local_descriptors(features)
        return describe_regions(features, find_regions(features, REGIONS[kind]))

    share = -(-max(_POINTS, _POINTS_PER_WORD * count) // sum(len(list_images(name)) for name in folders))
    points = []
    for picture in read_pictures(folders, "describing"):
        found = described(picture)
        points.append(found[rng.permutation(len(found))[:share]])
    return np.concatenate(points or [np.empty((0, 1), np.float32)]), len(points)


def kmeans(points: Singles, count: int, rounds: int, rng: np.random.Generator) -> Iterator[Singles]:
    """Yield `count` centres, float32 (count, D), of `points` float32 (N, D), after each of `rounds` (Lloyd 1982).

    The centres start as points drawn at random. A centre that is nearest to no point moves to one of the points that
    lie furthest from their centres. N must be at least `count`.
    """
    centres = points[np.sort(rng.choice(len(points), count, replace=False))].copy()
    for _ in range(rounds):
        nearest_centre, distance = _assigned(points, centres)
        order = np.argsort(nearest_centre, kind="stable")
        sizes = np.bincount(nearest_centre, minlength=count)
        used = np.flatnonzero(sizes)
        starts = np.concatenate([[0], np.cumsum(sizes[used])[:-1]])
        # Sorted by centre, the points of one centre are neighbours, and `reduceat` can sum them.
        centres[used] = np.add.reduceat(points[order], starts, axis=0) / sizes[used, None]
        empty = np.flatnonzero(sizes == 0)
        centres[empty] = points[np.argsort(-distance, kind="stable")[: len(empty)]]
        yield centres


def _assigned(points: Singles, centres: Singles) -> tuple[Ints, Singles]:
    """Find the nearest centre of each point. Returns its number, int (N,), and its squared distance, float32 (N,)."""
    numbers = np.empty(len(points), np.intp)
    distance = np.empty(len(points), np.float32)
    half_squares = 0.5 * np.einsum("kd,kd->k", centres, centres)
    rows = max(1, _BLOCK_VALUES // len(centres))
    for start in range(0, len(points), rows):  # block by block: for ten thousand words of a hundred thousand points
        block = points[start : start + rows]
        closeness = block @ centres.T
        closeness -= half_squares
        best = closeness.argmax(axis=1)
        numbers[start : start + rows] = best
        own = np.einsum("nd,nd->n", block, block)
        distance[start : start + rows] = own - 2 * closeness[np.arange(len(block)), best]
    return numbers, distance


if __name__ == "__main__":
    try:
        main()
    except EdgevprError as error:
        sys.exit(f"train_words: {error}")
