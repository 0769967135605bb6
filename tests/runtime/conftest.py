"""One recorded flight for all tests of flights: thirty places, 111 m apart on a line to the north, and maps of them."""

import shutil
from functools import partial
from pathlib import Path

import pytest
from fakes import FakeClock
from flights import PLACES, STEP_DEG, connect_autopilot, draw_pictures, prepare_flight
from pictures import write_flight

from edgevpr.cli.main import main
from edgevpr.runtime.flight import systemd
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.notifier import Notifier

# Small and quick: what flights are tested on here is not how well a technique recognises.
TECHNIQUES = {"cohog": ("w1=208",), "hog": ("w1=64",), "seqslam": ()}


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """`seen` are pictures with positions, `blind` the same without, and there is a map of each technique."""
    folder = tmp_path_factory.mktemp("recording")
    for name in ("seen", "blind"):
        write_flight(folder / name / "images", draw_pictures(PLACES), STEP_DEG)
    (folder / "blind" / "images" / "positions.csv").unlink()
    for technique, parameters in TECHNIQUES.items():
        flags = [word for parameter in parameters for word in ("--param", parameter)]
        built = ["map", "build", folder / f"{technique}.gpkg", "--images", folder / "seen" / "images"]
        assert main([*map(str, built), "--technique", technique, "--no-calibrate", *flags]) == 0
    return folder


@pytest.fixture
def place_map(recording, tmp_path):
    """A copy of the map of cohog, to be harmed."""
    return Path(shutil.copy(recording / "cohog.gpkg", tmp_path / "m.gpkg"))


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def link(clock):
    return connect_autopilot(clock)


@pytest.fixture
def make_flight(recording, tmp_path, link, clock):
    """Make a flight with `link` by `clock`, a query a second: `make_flight("cohog", **settings)`."""
    return partial(prepare_flight, recording, tmp_path, link, clock)


@pytest.fixture
def statuses(monkeypatch):
    """The statuses that systemd is sent."""
    sent = []
    monkeypatch.setattr(systemd, "notify", lambda STATUS="", **_: sent.append(STATUS) if STATUS else None)
    return sent


@pytest.fixture
def notifier(tmp_path, link, clock):
    """A notifier whose log is `tmp_path`/log."""
    with FlightLog(tmp_path / "log", clock=clock) as log:
        yield Notifier(log, link)
