"""Shared by the tests of live sources."""

import pytest

from edgevpr.frames import streams
from edgevpr.frames.source import open_source


@pytest.fixture
def opened(monkeypatch):
    """open_source for live sources, with a short read time-out; closed at the end."""
    monkeypatch.setattr(streams, "READ_TIMEOUT_S", 0.7)
    sources = []

    def open_live(uri):
        sources.append(open_source(uri, live=True))
        return sources[-1]

    yield open_live
    for source in sources:
        source.close()
