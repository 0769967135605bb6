"""What the tests of several rooms share."""

import pytest


@pytest.fixture
def models(tmp_path, monkeypatch):
    """A models folder of the user's own, empty."""
    folder = tmp_path / "models"
    folder.mkdir()
    monkeypatch.setenv("EDGEVPR_MODELS", str(folder))
    return folder
