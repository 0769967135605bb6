"""The log of a flight that ended with the battery: cut at any byte, it is still a page."""

import json

import pytest
from logs import query, write_log

from edgevpr.core.errors import EdgevprError
from edgevpr.review.album import Album
from edgevpr.review.logged import read_flight
from edgevpr.review.page import make_flight_page


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A log of three queries, as short as one can be."""
    folder = tmp_path_factory.mktemp("logs")
    located = {"lat_deg": -33.5, "lon_deg": 151.25}
    return write_log(folder / "whole.jsonl", *(("query", query(name, located=located)) for name in "abc"))


@pytest.mark.slow
def test_a_log_that_was_cut_at_any_byte_is_read_up_to_its_last_whole_line(log, tmp_path):
    whole, cut_log = log.read_bytes(), tmp_path / "cut.jsonl"
    ends = [place for place, byte in enumerate(whole) if byte == ord("\n")]
    is_query = [json.loads(line)["kind"] == "query" for line in whole.splitlines()]
    for cut in range(len(whole) + 1):
        cut_log.write_bytes(whole[:cut])
        there = sum(end <= cut for end in ends)  # the end of the last line may be missing
        if not there:
            with pytest.raises(EdgevprError, match=r"cut\.jsonl"):
                read_flight(cut_log)
            continue
        flight = read_flight(cut_log)
        assert len(flight.queries) == sum(is_query[:there])
        if cut + 1 in ends:
            make_flight_page(flight, [], Album(), Album())
        assert all(query.position == (-33.5, 151.25) for query in flight.queries)
