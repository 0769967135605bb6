"""What a flight says of its own cost: by the closed form, by the process's own clock, and with the board's heat."""

import random
import time

import cv2
import pytest
from flight_process import start, write_frames
from pictures import textured

from edgevpr.cli import main
from edgevpr.config import load_config
from edgevpr.frames.live import LiveSource
from edgevpr.power import meter
from edgevpr.power.thermal import ThermalState
from edgevpr.runtime.flight import loop, metering
from edgevpr.runtime.flight.flightlog import FlightLog, read_log
from edgevpr.runtime.flight.loop import Flight
from edgevpr.runtime.recognise import pipeline
from edgevpr.runtime.recognise.pipeline import open_pipeline
from edgevpr.types import Frame


class Clocks:
    """Stands in for the module `time`."""

    def __init__(self):
        self.now_s, self.cpu_s = 1000.0, 7.0

    def monotonic(self):
        return self.now_s

    def process_time(self):
        return self.cpu_s

    thread_time = process_time

    def sleep(self, seconds):
        self.now_s += seconds

    def work(self, wall_s, cores):
        self.now_s += wall_s
        self.cpu_s += wall_s * cores


@pytest.fixture
def clocks(monkeypatch):
    clocks = Clocks()

    def stage(cpu_clock=clocks.process_time):
        return meter.stage(clocks.monotonic, cpu_clock)

    for module in (loop, metering):
        monkeypatch.setattr(module, "time", clocks)
    for module in (loop, pipeline):
        monkeypatch.setattr(module, "stage", stage)
    return clocks


@pytest.fixture(scope="module")
def place_map(tmp_path_factory):
    folder = tmp_path_factory.mktemp("metering")
    write_frames(folder / "ref", 60)  # more than are compared in full
    path = folder / "m.gpkg"
    assert main(["map", "build", str(path), "--images", str(folder / "ref"), "--technique", "cohog"]) == 0
    return path


class Camera:
    """A live source of `count` pictures; reading one is work too."""

    total, state = 0, "streaming"

    def __init__(self, count, work=lambda: None):
        self._left, self._work, self._picture = count, work, textured(1, 240, 320)

    @property
    def ended(self):
        return not self._left

    def read(self, timeout_s):
        self._work()
        self._left -= 1
        return Frame(image=self._picture, name="frame", t_mono_s=time.monotonic())


class Ground:
    """A link that keeps what it was given."""

    def __init__(self):
        self.sent = []

    def send(self, *messages):
        self.sent += messages

    def vehicle_position(self, max_age_s):
        return None

    def send_fix(self, fix):
        pass

    set_health = send_fix


def fly(place_map, log, source, link=None, prepare=lambda pipe: None, **settings):
    """Fly in this process: (lines of the log, the flight)."""
    config = load_config(None, {"map": str(place_map), **settings})
    pipe = open_pipeline(config)
    prepare(pipe)
    with pipe.place_map, FlightLog(log) as flight_log:
        flight = Flight(pipe, source, flight_log, link, config)
        flight.run()
        flight.close()
    return list(read_log(log)), flight


def test_a_flights_charge_is_the_closed_form(place_map, tmp_path, clocks):
    """Five minutes on a Pi 4B (2.29 W idle, 4.53 W more at full load, four cores) with stages of all lengths."""
    script = random.Random(5)
    spent = []

    def work():
        wall_s, cores = script.uniform(0.001, 0.6), script.uniform(0, 2)
        spent.append(wall_s * cores)
        clocks.work(wall_s, cores)

    def prepare(pipe):
        encode, scan = pipe.technique.encode, pipe.technique.coarse_scores
        pipe.technique.encode = lambda image: (work(), encode(image))[1]
        pipe.technique.coarse_scores = lambda *asked: (work(), scan(*asked))[1]

    settings = {"board": "rpi-4b", "source.rate_hz": 0.5, "match.candidates": 1}
    lines, flight = fly(place_map, tmp_path / "log", Camera(150, work), prepare=prepare, **settings)
    totals, elapsed_s = flight.totals, clocks.now_s - 1000
    assert elapsed_s > 290
    mah = 1000 / (14.8 * 0.85 * 3600)  # of a joule, with the pack of the configuration
    busy_j = 4.53 / 4 * sum(spent)
    assert len(spent) == 3 * 150
    assert totals["used_mah"] == pytest.approx(mah * (2.29 * elapsed_s + busy_j), rel=1e-9)
    assert totals["process_mah"] == pytest.approx(mah * busy_j, rel=1e-9)
    assert totals["marginal_mah"] == pytest.approx(mah * busy_j, rel=1e-9), "nothing else was done"
    assert totals["stages_cpu_s"] == pytest.approx(sum(spent), rel=1e-9)
    # The queries' own charge is idle power while they last and what they add; reading the picture stands beside it.
    queries = [line for line in lines if line["kind"] == "query"]
    assert len(queries) == 150
    in_queries_mah = sum(line["costs"]["marginal_mah"] for line in queries)
    reading_mah = mah * 4.53 / 4 * sum(line["reading"]["cpu_s"] for line in queries)
    assert in_queries_mah + reading_mah == pytest.approx(totals["marginal_mah"], rel=1e-5), "the log has six digits"
    assert sum(line["costs"]["used_mah"] for line in queries) < totals["used_mah"]
    assert queries[-1]["totals"]["used_mah"] == pytest.approx(totals["used_mah"], rel=1e-6)


def test_the_stages_account_for_the_cpu_time_of_the_process(place_map, tmp_path):
    """A real flight: what is no stage of a query (threads, the loop between queries) is less than three percent. Where
    other programs take the cores and the caches it can be more: such a flight is flown again, twice at most."""
    write_frames(tmp_path / "query", 40)
    for attempt in range(3):
        log = tmp_path / f"log{attempt}"
        flight = start(place_map, tmp_path / "query", log, "--rate-hz", "15", "--link", "udpout:127.0.0.1:9")
        assert flight.wait(timeout=60) == 0
        flight.stderr.close()
        lines = list(read_log(log))
        if lines[-1]["stages_cpu_s"] > 0.97 * lines[-1]["process_cpu_s"]:
            break
    queries, end = [line for line in lines if line["kind"] == "query"], lines[-1]
    in_queries_s = sum(line["costs"]["cpu_s"] + line["reading"]["cpu_s"] for line in queries)
    assert 0.95 * end["stages_cpu_s"] < in_queries_s < end["stages_cpu_s"], "the rest is the log and the link"
    assert end["stages_cpu_s"] == pytest.approx(end["process_cpu_s"], rel=0.03)
    assert end["elapsed_s"] > end["process_cpu_s"] / 2
    assert all(line["costs"]["rss_mb"] > line["costs"]["pss_mb"] > 10 for line in queries)
    assert queries[0]["totals"]["dropped"] is None, "of a recording every picture is taken"
    assert set(queries[0]["board"]) == {"temperature_c", "frequency_mhz", "throttled", "why"}


def test_heat_is_logged_and_told_and_a_throttled_boards_figures_are_marked(place_map, tmp_path, monkeypatch):
    states = iter(
        [ThermalState(61.0, 1800.0, False, "")] * 3 + [ThermalState(84.0, 600.0, True, "throttled now")] * 999
    )

    class Watch:
        def __init__(self, clock):
            pass

        def look(self):
            return next(states)

        def close(self):
            pass

    monkeypatch.setattr(metering, "ThermalWatch", Watch)
    monkeypatch.setattr(loop, "_HEALTH_S", 0.0)
    ground = Ground()
    lines, flight = fly(place_map, tmp_path / "log", Camera(6), ground, **{"source.rate_hz": 60.0})
    boards = [line["board"] for line in lines if line["kind"] == "query"]
    assert boards[0] == {"temperature_c": 61.0, "frequency_mhz": 1800.0, "throttled": False, "why": ""}
    assert boards[-1] == {"temperature_c": 84.0, "frequency_mhz": 600.0, "throttled": True, "why": "throttled now"}
    told = [each.temperature_core[0] for each in ground.sent if each.get_type() == "ONBOARD_COMPUTER_STATUS"]
    throttled = [board["throttled"] for board in boards]
    assert flight.totals["queries_throttled"] == sum(throttled) > 0
    assert told[0] == 61
    assert told[-1] == 84


class Capture:
    """A camera of 200 pictures a second."""

    def read(self):
        time.sleep(0.005)
        return True, cv2.cvtColor(textured(1, 240, 320), cv2.COLOR_GRAY2BGR)

    def release(self):
        pass


def test_frames_that_nobody_took_are_counted(place_map, tmp_path):
    source = LiveSource(Capture, time.monotonic)

    class Ground3(Ground):
        """Stops the flight after three queries."""

        def send(self, *messages):
            source.ended = flight_queries() >= 3

    def flight_queries():
        return sum(line["kind"] == "query" for line in read_log(tmp_path / "log"))

    lines, flight = fly(place_map, tmp_path / "log", source, Ground3(), **{"source.rate_hz": 5.0})
    source.close()
    dropped = [line["totals"]["dropped"] for line in lines if line["kind"] == "query"]
    assert dropped == sorted(dropped)
    assert dropped[-1] >= 10, "at 5 Hz most of its pictures are passed over"
    assert flight.totals["dropped"] == source.dropped


def test_the_log_ends_with_what_the_board_has_drawn(place_map, tmp_path):
    """Idle power counts while nothing is recognised: two queries, and two seconds between them."""
    write_frames(tmp_path / "query", 2)
    flight = start(place_map, tmp_path / "query", tmp_path / "log", "--rate-hz", "0.5", "--board", "rpi-4b")
    assert flight.wait(timeout=60) == 0
    flight.stderr.close()
    lines = list(read_log(tmp_path / "log"))
    end = lines[-1]
    idle_mah = 1000 * 2.29 * end["elapsed_s"] / (14.8 * 0.85 * 3600)
    assert end["elapsed_s"] > 2
    assert end["used_mah"] == pytest.approx(idle_mah + end["process_mah"], rel=1e-5)
    assert sum(line["costs"]["used_mah"] for line in lines if line["kind"] == "query") < end["used_mah"] / 2
    assert 0 < end["marginal_mah"] <= end["process_mah"] < idle_mah
