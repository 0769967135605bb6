"""Memory is a promise: `edgevpr run` with a map of some size, as a process of its own under a hard limit."""

import os
import shutil
import tracemalloc

import pytest
from big_map import estimate_file_bytes, make_big_map
from flight_process import finish_flight, start, watch_memory, write_frames

from edgevpr.places.index import compute_place_bytes, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.flight.flightlog import read_log
from edgevpr.techniques import create

pytestmark = pytest.mark.process

PLACES = 1000
FRAMES = 30
LIMIT_BYTES = 700_000_000  # of address space: libraries that are mapped and never touched count as well
WARM_AFTER = 10  # queries, until every buffer is there
SPARE_BYTES = 1_000_000_000


@pytest.fixture(scope="module")
def big_map(tmp_path_factory):
    """A map of cohog; forgotten with the last test, since it is large."""
    folder = tmp_path_factory.mktemp("memory")
    spec = create("cohog").spec
    if shutil.disk_usage(folder).free < SPARE_BYTES + estimate_file_bytes(spec, PLACES):
        pytest.skip(f"less than 1 GB is free in {folder}")
    make_big_map(folder / "big.gpkg", spec, PLACES)
    yield folder / "big.gpkg"
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def flight(big_map):
    """A whole flight within the limit: (its log, the largest memory figures, files mapped).

    Two cores, as boards have few: every thread of a pool takes address space of its own."""
    if not (shutil.which("prlimit") and shutil.which("taskset")):
        pytest.skip("prlimit and taskset are not on this machine (Debian: apt install util-linux)")
    write_frames(big_map.parent / "frames", FRAMES)
    two_cores = ",".join(map(str, sorted(os.sched_getaffinity(0))[:2]))
    log = big_map.parent / "flight.jsonl"
    process = start(
        big_map, big_map.parent / "frames", log, "--link", "udpout:127.0.0.1:9", "--rate-hz", "60",
        through=["prlimit", f"--as={LIMIT_BYTES}", "taskset", "--cpu-list", two_cores],
    )  # fmt: skip
    largest, mapped = watch_memory(process)
    finish_flight(process)
    return list(read_log(log)), largest, mapped


def test_flight_completes_within_a_hard_limit_of_memory(flight):
    lines, largest, _ = flight
    assert lines[-1]["kind"] == "end"
    assert lines[-1]["queries"] == FRAMES
    assert largest["VmPeak"] < LIMIT_BYTES / 1e6


def test_flight_uses_60_mb_and_140_with_libraries(flight):
    largest = flight[1]
    assert 30 < largest["Pss"] <= largest["VmHWM"]
    assert largest["RssAnon"] < 60
    # Pages of libraries are counted as the system has them in its cache: the same flight had 93, 103 and 132 MB.
    assert largest["VmHWM"] < 140


def test_flight_does_not_grow_from_query_to_query(flight):
    told_mb = [line["costs"]["rss_mb"] for line in flight[0] if line["kind"] == "query"]
    assert max(told_mb[WARM_AFTER:]) < told_mb[WARM_AFTER - 1] + 4


def test_flight_loads_no_unneeded_library(flight):
    mapped = flight[2]
    assert "cv2" in mapped
    assert "onnxruntime" not in mapped
    assert "matplotlib" not in mapped


# Choosing which places stay takes lists of all of them, for a moment.
@pytest.mark.parametrize(("share", "extra_bytes"), [(1.0, 1_000_000), (0.5, 2_500_000)])
def test_load_index_stays_within_its_budget(big_map, share, extra_bytes):
    technique = create("cohog")
    budget_bytes = int(share * PLACES) * compute_place_bytes(technique.spec)
    with PlaceMap.open(big_map) as place_map:
        load_index(place_map, technique, budget_bytes)  # numpy loads parts of itself at their first use
        tracemalloc.start()
        index = load_index(place_map, technique, budget_bytes)
        peak_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert len(index) == share * PLACES
    assert index.nbytes <= budget_bytes
    assert peak_bytes < budget_bytes + extra_bytes
