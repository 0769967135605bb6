"""`edgevpr train words`: the visual words of VLAD and bag-of-words, learned by k-means from one's own pictures.

`techniques.words.load_words` reads the file. It holds `words` float16 (K, D), rounded to steps of 1/256 so that
ten thousand of them take little room, and `model_sha256`, the fingerprint of the card whose feature map they describe.
If asked for, it also holds the whitening of the VLAD vectors made of the words (Jégou and Chum, ECCV 2012).
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.files import model_folders, write_whole
from edgevpr.core.text import progress
from edgevpr.frames.images import list_images
from edgevpr.lab.training.kmeans import kmeans
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


@dataclass(frozen=True, slots=True)
class WordsResult:
    """Result of a training of words: the file, the numbers of pictures and local descriptors it was learned from, and
    the mean square distance of a descriptor to its word (2: nothing in common)."""

    file: str
    pictures: int
    descriptors: int
    distance: float


def train_words(
    folders: Sequence[str],
    model: str,
    kind: str,
    count: int,
    whiten: int | None,
    folder: Path | None,
    seed: int,
    unusable: list[ImageError],
) -> WordsResult:
    """Learn `count` words of `kind` ("vlad", "regions", "bow") and write <model>_<kind><count>.npz to `folder` (None:
    the user's own models folder).

    `whiten` is the length of the whitened VLAD vectors (None: no whitening). Raises UsageError for settings that make
    no sense, a file that exists already or too few descriptors, ModelError for a network that cannot be used,
    SourceError for a folder without images.
    """
    if count < 2 or seed < 0 or (whiten is not None and whiten < 1):
        raise UsageError(f"--count {count} --seed {seed}: give at least 2 words, a seed of 0 or more, --whiten from 1.")
    if whiten is not None and kind != "vlad":
        raise UsageError(f"--whiten is for --kind vlad: leave it out for {kind}.")
    folder = model_folders()[0] if folder is None else folder
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{model}_{kind}{count}.npz"
    if path.exists():
        raise UsageError(f"{path} is there already: delete it, or give another --out.")
    backbone = open_backbone(model, "features")
    rng = np.random.default_rng(seed)
    wanted = max(_POINTS, _POINTS_PER_WORD * count)
    each = -(-wanted // sum(len(list_images(name)) for name in folders))
    local = _locals(backbone, kind)
    points_of = [_some(local(picture), each, rng) for picture in read_pictures(folders, "describing", unusable)]
    pictures = len(points_of)
    points = np.concatenate(points_of or [np.empty((0, backbone.shape[0]), np.float32)])
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
    words = (np.rint(centres * _STEP) / _STEP).astype(np.float16)
    arrays = {"words": words, "model_sha256": np.array(backbone.sha256)}
    if whiten is not None:
        arrays |= _whitening(backbone, folders, pictures, words.astype(np.float32), whiten)
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    write_whole(path, lambda unfinished: unfinished.write_bytes(content.getbuffer()))
    some, words = points[:: max(1, len(points) // 5000)], words.astype(np.float32)
    distance = np.square(some - words[nearest(some, words)]).sum(axis=1).mean()
    return WordsResult(str(path), pictures, len(points), float(distance))


def _locals(backbone: Backbone, kind: str) -> Callable[[np.ndarray], np.ndarray]:
    """Make the function from a picture to its local descriptors, float32 (N, C), each of length 1."""
    if kind == "vlad":
        return lambda picture: local_descriptors(backbone.run(picture))

    def regions(picture: np.ndarray) -> np.ndarray:
        features = backbone.run(picture)
        return describe(features, find_regions(features, REGIONS[kind]))

    return regions


def _some(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    return points[rng.permutation(len(points))[:count]]


def _whitening(
    backbone: Backbone, folders: Sequence[str], pictures: int, words: np.ndarray, length: int
) -> dict[str, np.ndarray]:
    """Learn the whitening: the principal components of the pictures' VLAD vectors over the root of their variance.
    Returns the mean float32 (K D,), the matrix int8 (length, K D) and the scale of its rows float32 (length,)."""
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
