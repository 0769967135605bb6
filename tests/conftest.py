"""What the tests of several rooms share."""

import os

import pytest

# As edgevpr's command line does, before anything imports NumPy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@pytest.fixture
def models(tmp_path, monkeypatch):
    """A models folder of the user's own, empty."""
    folder = tmp_path / "models"
    folder.mkdir()
    monkeypatch.setenv("EDGEVPR_MODELS", str(folder))
    return folder
