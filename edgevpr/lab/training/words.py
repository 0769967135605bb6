"""`edgevpr train words`: visual words, learned by k-means from one's own pictures.

The file that `techniques.words.load_words` reads holds `words` float16 (K, D), rounded to steps of 1/256 so that ten
thousand of them take little room, and `model_sha256`, the fingerprint of the card whose feature map they describe. If
asked for, it also holds the whitening of the VLAD vectors made of the words (Jégou and Chum, ECCV 2012).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Array, Image, Ints, Singles
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.files import model_folders, write_whole
from edgevpr.core.text import progress
from edgevpr.frames.images import list_images
from edgevpr.lab.training.pictures import read_pictures
from edgevpr.techniques.regions import describe, find_regions
from edgevpr.techniques.session import Backbone, open_backbone
from edgevpr.techniques.words import local_descriptors, nearest, sharpness_of, vlad

REGIONS = {"regions": 400, "bow": 200}  # regions per picture, as in `region_vlad` and `cross_region_bow`
_POINTS = 60_000  # the fewest local descriptors to learn words from, if there are as many ...
_POINTS_PER_WORD = 12  # ... and the fewest per word
_ROUNDS = 10
_STEP = 256
_ALIKE = 1e-9  # variance of vectors of length 1 that are the same but for rounding
_LEAST_VARIANCE = 1e-3  # of the largest: a smaller variance is mostly noise, which whitening must not amplify
_JUDGED = 5000  # of the points: enough to tell how well the words fit
_BLOCK_VALUES = 8_000_000  # distances held at once: 32 MB


@dataclass(frozen=True, slots=True)
class WordsWanted:
    """The words to learn: `count` of a `kind` ("vlad" for `netvlad`, "regions" for `region_vlad`, "bow" for
    `cross_region_bow`) on the feature map of the card `model`. `whiten` is the length of the whitened VLAD vectors
    (None: no whitening)."""

    model: str
    kind: str
    count: int
    whiten: int | None


@dataclass(frozen=True, slots=True)
class WordsResult:
    """Result of a training of words: the file, the numbers of pictures and of descriptors it was learned from, and the
    mean square distance of a descriptor to its nearest word (2: nothing in common)."""

    file: str
    pictures: int
    descriptors: int
    distance: float


def train_words(
    folders: Sequence[str], wanted: WordsWanted, folder: Path | None, seed: int, unusable: list[ImageError]
) -> WordsResult:
    """Learn words and write <model>_<kind><count>.npz to `folder` (None: the user's own models folder).

    Raises UsageError for settings that make no sense, a file that exists already or too few descriptors, ModelError for
    a network that cannot be used, SourceError for a folder without images.
    """
    count, whiten = wanted.count, wanted.whiten
    if count < 2 or seed < 0 or (whiten is not None and whiten < 1):
        raise UsageError(f"--count {count} --seed {seed}: give at least 2 words, a seed of 0 or more, --whiten from 1.")
    if whiten is not None and wanted.kind != "vlad":
        raise UsageError(f"--whiten is for --kind vlad: leave it out for {wanted.kind}.")
    folder = model_folders()[0] if folder is None else folder
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{wanted.model}_{wanted.kind}{count}.npz"
    if path.exists():
        raise UsageError(f"{path} is there already: delete it, or give another --out.")
    backbone = open_backbone(wanted.model, "features")

    def described(picture: Image) -> Singles:
        features = backbone.run(picture)
        if wanted.kind == "vlad":
            return local_descriptors(features)
        return describe(features, find_regions(features, REGIONS[wanted.kind]))

    rng = np.random.default_rng(seed)
    points, pictures = _gathered(folders, described, max(_POINTS, _POINTS_PER_WORD * count), rng, unusable)
    if whiten is not None and whiten >= pictures:
        raise UsageError(
            f"--whiten {whiten} needs more than {whiten} usable images, and there are {pictures}: give more, or a "
            "smaller --whiten."
        )
    if len(points) < 2 * count:
        raise UsageError(
            f"{pictures} usable images give {len(points)} descriptors, too few for {count} words: give more images, "
            f"or a --count of at most {len(points) // 2}."
        )
    *_, centres = progress(kmeans(points, count, _ROUNDS, rng), _ROUNDS, "learning")
    stored = (np.rint(centres * _STEP) / _STEP).astype(np.float16)
    words = stored.astype(np.float32)
    arrays = {"words": stored, "model_sha256": np.array(backbone.sha256)}
    if whiten is not None:
        arrays |= _whitening(backbone, folders, pictures, words, whiten)
    return _written(path, arrays, points, words, pictures)


def _gathered(
    folders: Sequence[str],
    described: Callable[[Image], Singles],
    wanted: int,
    rng: np.random.Generator,
    unusable: list[ImageError],
) -> tuple[Singles, int]:
    """Collect descriptors of the pictures in `folders`: of those of each picture, `described` (n, D), so many random
    ones that all pictures give about `wanted`. Returns them, float32 (N, D), and the number of pictures."""
    share = -(-wanted // sum(len(list_images(name)) for name in folders))
    points = []
    for picture in read_pictures(folders, "describing", unusable):
        found = described(picture)
        points.append(found[rng.permutation(len(found))[:share]])
    return np.concatenate(points or [np.empty((0, 1), np.float32)]), len(points)


def _written(path: Path, arrays: dict[str, Array], points: Singles, words: Singles, pictures: int) -> WordsResult:
    def write(unfinished: Path) -> None:
        with open(unfinished, "wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # numpy's third parameter is a bool

    write_whole(path, write)
    some = points[:: max(1, len(points) // _JUDGED)]
    distance = np.square(some - words[nearest(some, words)]).sum(axis=1).mean()
    return WordsResult(str(path), pictures, len(points), float(distance))


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


def _whitening(
    backbone: Backbone, folders: Sequence[str], pictures: int, words: Singles, length: int
) -> dict[str, Array]:
    """Learn a whitening: the principal components of the pictures' VLAD vectors, each over the root of its variance."""
    sharpness = sharpness_of(words)
    vectors = np.empty((pictures, words.size), np.float32)
    for row, picture in enumerate(read_pictures(folders, "whitening")):
        vectors[row] = vlad(local_descriptors(backbone.run(picture)), words, sharpness)
    mean = vectors.mean(axis=0)
    vectors -= mean
    # There are fewer pictures than values, so the components come from the small product of pictures with pictures.
    variance, mixing = np.linalg.eigh((vectors @ vectors.T).astype(np.float64) / len(vectors))
    variance, mixing = variance[::-1][:length], mixing[:, ::-1][:, :length]
    if not variance[0] > _ALIKE:
        raise UsageError("The images are all alike, and a whitening needs what tells them apart: give others.")
    variance = np.maximum(variance, _LEAST_VARIANCE * variance[0])
    matrix = (mixing / (np.sqrt(len(vectors)) * variance)).T.astype(np.float32) @ vectors
    scale = np.abs(matrix).max(axis=1) / 127
    whitening = np.rint(matrix / scale[:, None]).astype(np.int8)
    return {"mean": mean, "whitening": whitening, "whitening_scale": scale.astype(np.float32)}
