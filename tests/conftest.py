"""What the tests of several rooms share."""

import logging
import os
import signal

import pytest
from documented import Checked

import edgevpr  # noqa: F401  # it sets OpenCV's limit of pixels, which counts when OpenCV is imported
from edgevpr.cli import shared

# As edgevpr's command line does, before anything imports NumPy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# A script that starts the tests in the background has Ctrl-C ignored, and so would every program that they start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Files that take long and would come late. They begin first, so that no process ends alone with one of them.
LONGEST = (
    "test_never_worse",
    "test_navigator",
    "test_flight_process",
    "test_feedback",
    "test_gate",
    "test_replay",
    "test_survey",
    "test_agewatch",
    "test_odometry_gaps",
    "test_ground_stations",
    "test_memory",
    "test_interface",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Bring the longest files to the front."""
    rank = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(LONGEST)))


@pytest.fixture(autouse=True)
def documented(monkeypatch):
    """Whatever test prints a result as JSON, it is as its schema says."""
    monkeypatch.setattr(shared, "json", Checked)


@pytest.fixture(autouse=True)
def reset_quiet():
    """After a test that called a command with -q, the next one of the process is told of progress again."""
    yield
    logging.getLogger("edgevpr").setLevel(logging.NOTSET)


@pytest.fixture
def models(tmp_path, monkeypatch):
    """A models folder of the user's own, empty."""
    folder = tmp_path / "models"
    folder.mkdir()
    monkeypatch.setenv("EDGEVPR_MODELS", str(folder))
    return folder


@pytest.fixture
def tree(tmp_path):
    """Write files below a root, such as a machine's /proc and /sys: tree({"proc/meminfo": "..."}) -> the root. Further
    calls change and add files."""

    def write(files):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path

    return write
