"""Shared by the tests of this folder."""

import cv2
import numpy as np
import pytest

from edgevpr.frames import streams
from edgevpr.frames.source import open_source


@pytest.fixture
def open_live_source(monkeypatch):
    """open_source for live sources, with a short read time-out; closed at the end."""
    monkeypatch.setattr(streams, "READ_TIMEOUT_S", 0.7)
    sources = []

    def open_live(uri):
        sources.append(open_source(uri, live=True))
        return sources[-1]

    yield open_live
    for source in sources:
        source.close()


@pytest.fixture(scope="session")
def ground():
    """Ground without relief, (1600, 1600, 3), smooth enough that a picture of a picture is hardly another."""
    rng = np.random.default_rng(1)
    octaves = [rng.random((2**octave, 2**octave, 3), dtype=np.float32) / octave for octave in range(3, 8)]
    smooth = sum(cv2.resize(each, (1600, 1600), interpolation=cv2.INTER_CUBIC) for each in octaves)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
