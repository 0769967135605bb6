"""Ways of recognising places that a researcher would reach for first, each with the library that does it.

Each is a `Way`: `learn` makes what it needs of training pictures (words), `encode` a descriptor of a picture, `index`
one of all references, and `scores` gives every reference a score, higher is more alike. Pictures are uint8, (H, W)
grey.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

WORDS_ORB, WORDS_SIFT, FEATURES = 1000, 64, 500
RATIO = 0.75
_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 1e-3)
SIDE_PX = 512


@dataclass(frozen=True, slots=True)
class Way:
    """A way of recognising: see the module. `nbytes` is what a reference takes in memory."""

    encode: Callable[[np.ndarray, Any], Any]
    scores: Callable[[Any, Any], np.ndarray]
    learn: Callable[[Sequence[np.ndarray]], Any] = lambda pictures: None
    index: Callable[[Sequence[Any], Any], Any] = lambda found, words: list(found)
    nbytes: Callable[[Any, int], float] = lambda places, count: sum(each.nbytes for each in places) / count


def published_cohog() -> Way:
    """CoHOG as published (competitor.py), with the entropy of its authors' code: the one that the thesis prints finds
    less."""
    sys.path.append(str(Path(__file__).parents[1]))
    import competitor

    def encode(grey: np.ndarray, _: Any) -> tuple[np.ndarray, np.ndarray]:
        square = cv2.resize(grey, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA).astype(np.float32)
        return competitor.encode(square, "shannon")

    def scores(asked: tuple[np.ndarray, np.ndarray], places: list[np.ndarray]) -> np.ndarray:
        regions, good = asked
        return np.array(competitor.match(regions, good, places)) if good.any() else np.zeros(len(places))

    return Way(encode, scores, index=lambda found, _: [regions for regions, _ in found])


def orb_with_ratio_test() -> Way:
    """500 ORB features a picture, by Hamming distance."""
    return _ratio_test(cv2.ORB_create(FEATURES))


def sift_with_ratio_test() -> Way:
    """500 SIFT features a picture, by Euclidean distance."""
    return _ratio_test(cv2.SIFT_create(FEATURES))


def _ratio_test(detector: cv2.Feature2D) -> Way:
    """Compare all features of two pictures, without a check of their geometry; the score is how many pass the ratio
    test (Lowe 2004)."""
    matcher = cv2.BFMatcher(detector.defaultNorm())

    def passed(asked: np.ndarray, place: np.ndarray) -> int:
        if len(asked) < 2 or len(place) < 2:
            return 0
        pairs = matcher.knnMatch(asked, place, k=2)
        return sum(len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance for pair in pairs)

    return Way(
        encode=lambda grey, _: _features(detector, grey),
        scores=lambda asked, places: np.array([passed(asked, place) for place in places], float),
    )


def bag_of_orb_words() -> Way:
    """1,000 words of ORB features (k-means of their bits), a histogram weighed by tf-idf, compared by cosine."""
    orb = cv2.ORB_create(FEATURES)

    def features(grey: np.ndarray) -> np.ndarray:
        return np.unpackbits(_features(orb, grey), axis=1).astype(np.float32)

    def learn(pictures: Sequence[np.ndarray]) -> np.ndarray:
        return _words(np.concatenate([features(each) for each in pictures]), WORDS_ORB)

    def encode(grey: np.ndarray, words: np.ndarray) -> np.ndarray:
        found = features(grey)
        counts = np.bincount(_nearest(found, words), minlength=len(words)) if len(found) else np.zeros(len(words))
        return counts.astype(np.float32) / max(1, counts.sum())

    def index(found: Sequence[np.ndarray], _: Any) -> tuple[np.ndarray, np.ndarray]:
        counts = np.stack(found)
        weight = np.log(len(counts) / np.maximum(1, (counts > 0).sum(axis=0))).astype(np.float32)
        return _unit(counts * weight), weight

    return Way(
        learn=learn,
        encode=encode,
        index=index,
        scores=lambda asked, index: index[0] @ _unit(asked[None] * index[1])[0],
        nbytes=lambda index, count: index[0].nbytes / count,
    )


def sift_vlad() -> Way:
    """RootSIFT (Arandjelovic and Zisserman 2012) in a VLAD of 64 words with intra-normalisation (2013), by cosine."""
    sift = cv2.SIFT_create(FEATURES)

    def features(grey: np.ndarray) -> np.ndarray:
        found = _features(sift, grey)
        return np.sqrt(found / np.maximum(1e-6, found.sum(axis=1, keepdims=True)))

    def learn(pictures: Sequence[np.ndarray]) -> np.ndarray:
        return _words(np.concatenate([features(each) for each in pictures]), WORDS_SIFT)

    def encode(grey: np.ndarray, words: np.ndarray) -> np.ndarray:
        found, vlad = features(grey), np.zeros_like(words)
        if len(found):
            nearest = _nearest(found, words)
            np.add.at(vlad, nearest, found - words[nearest])
        return _unit(_unit(vlad).ravel()[None])[0]

    return Way(
        learn=learn,
        encode=encode,
        index=lambda found, _: np.stack(found),
        scores=lambda asked, places: places @ asked,
    )


def faiss_on_our_codes() -> Way:
    """The place codes of edgevpr's `cohog` looking ahead, 144 bytes, in FAISS's exhaustive binary index: one Hamming
    distance a place, without the shifts that edgevpr tries, and nothing is compared in full."""
    import faiss

    from edgevpr.techniques import create

    technique = create("cohog", {"camera": "forward"})
    faiss.omp_set_num_threads(1)  # its other threads wait by spinning, and that is counted

    def encode(grey: np.ndarray, _: Any) -> np.ndarray:
        return technique.encode(grey).coarse

    def index(found: Sequence[np.ndarray], _: Any) -> tuple[Any, np.ndarray]:
        grids = np.stack(found)
        mean = grids.astype(np.float32).mean(axis=0)
        codes = np.ascontiguousarray(technique.pack(grids, mean).view(np.uint8).reshape(len(grids), -1))
        binary = faiss.IndexBinaryFlat(8 * codes.shape[1])
        binary.add(codes)
        return binary, mean

    def scores(asked: np.ndarray, index: tuple[Any, np.ndarray]) -> np.ndarray:
        binary, mean = index
        code = np.ascontiguousarray(technique.pack(asked[None], mean).view(np.uint8).reshape(1, -1))
        distances, slots = binary.search(code, binary.ntotal)
        found = np.empty(binary.ntotal)
        found[slots[0]] = -distances[0]
        return found

    return Way(encode, scores, index=index, nbytes=lambda index, count: index[0].code_size)


WAYS: dict[str, Callable[[], Way]] = {
    "CoHOG, published": published_cohog,
    "ORB, ratio test": orb_with_ratio_test,
    "SIFT, ratio test": sift_with_ratio_test,
    "bag of ORB words": bag_of_orb_words,
    "SIFT-VLAD": sift_vlad,
    "FAISS on cohog's codes": faiss_on_our_codes,
}


def _features(detector: cv2.Feature2D, grey: np.ndarray) -> np.ndarray:
    """Return the descriptors of a picture's features, a row each."""
    found = detector.detectAndCompute(grey, None)[1]
    kind = np.uint8 if detector.descriptorType() == cv2.CV_8U else np.float32
    return np.zeros((0, detector.descriptorSize()), kind) if found is None else found


def _words(features: np.ndarray, count: int) -> np.ndarray:
    cv2.setRNGSeed(0)
    return cv2.kmeans(features.astype(np.float32), count, None, _CRITERIA, 1, cv2.KMEANS_PP_CENTERS)[2]


def _nearest(features: np.ndarray, words: np.ndarray) -> np.ndarray:
    return np.argmin((words**2).sum(axis=1) - 2 * features @ words.T, axis=1)


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(1e-12, np.linalg.norm(rows, axis=1, keepdims=True))
