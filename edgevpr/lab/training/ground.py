"""`edgevpr train ground`: the words by which `cohog` names places, looking down (see `techniques.placewords`).

The regions of one's own pictures, under several headings, are turned by quarter turns until they all run the same way,
and grouped by k-means. So a word stands for four: itself, and itself turned.
"""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.files import require_folder, write_whole
from edgevpr.core.text import progress
from edgevpr.frames.images import list_images
from edgevpr.lab.training.kmeans import kmeans
from edgevpr.lab.training.pictures import read_pictures
from edgevpr.techniques import placewords
from edgevpr.techniques.cohog import CoHog

_STEPS = (0, 2, 4)  # of 15 degrees
_POINTS = 90_000
_ROUNDS = 12


@dataclass(frozen=True, slots=True)
class GroundResult:
    """Result of a training: the file, the numbers of pictures and regions it was learned from, and the mean cosine of a
    region and its word."""

    file: str
    pictures: int
    regions: int
    cosine: float


def train_ground(folders: Sequence[str], out: Path, seed: int, unusable: list[ImageError]) -> GroundResult:
    """Learn 256 words, each of four turns, and write them to `out` (.npz).

    Raises UsageError for a file that exists already or too few regions, SourceError for a folder without images.
    """
    if out.suffix != ".npz" or out.exists():
        raise UsageError(f"--out {out}: give a name that ends in .npz, of a file that is not there.")
    require_folder(out)
    rng = np.random.default_rng(seed)
    technique = CoHog(camera="nadir")
    each = -(-_POINTS // (len(_STEPS) * sum(len(list_images(name)) for name in folders)))
    pictures, regions = 0, []
    for picture in read_pictures(folders, "describing", unusable):
        regions += [part[rng.permutation(len(part))[:each]] for part in _regions(technique, picture)]
        pictures += 1
    points = np.concatenate(regions) if regions else np.empty((0, 1))
    if len(points) < 2 * placewords.COUNT:
        raise UsageError(f"{pictures} usable images give {len(points)} regions, too few to learn from: give more.")
    *_, centres = progress(kmeans(aligned(points), placewords.COUNT, _ROUNDS, rng), _ROUNDS, "learning")
    words = (centres / np.linalg.norm(centres, axis=1, keepdims=True)).astype(np.float16)
    content = io.BytesIO()
    np.savez_compressed(content, words=words)
    write_whole(out, lambda unfinished: unfinished.write_bytes(content.getbuffer()))
    some = points[:: max(1, len(points) // 5000)]
    cosine = (some @ placewords.turned_words(words.astype(np.float32)).T).max(axis=1).mean()
    return GroundResult(str(out), pictures, len(points), float(cosine))


def aligned(patterns: np.ndarray) -> np.ndarray:
    """Turn patterns float32 (N, 20) by quarter turns until their main direction is within 45 degrees of the first
    orientation."""
    # The second and third pattern are the cosine and sine of the first frequency over the orientations.
    quarters = np.rint(np.arctan2(patterns[:, 2], patterns[:, 1]) / (np.pi / 2)).astype(np.intp) % placewords.QUARTERS
    turned = placewords.turned_words(patterns).reshape(len(patterns), placewords.QUARTERS, -1)
    return turned[np.arange(len(patterns)), quarters]


def _regions(technique: CoHog, picture: np.ndarray) -> Iterator[np.ndarray]:
    query = technique.encode(picture)
    for turn in _STEPS:
        yield technique.good_patterns(query, turn)[0]
