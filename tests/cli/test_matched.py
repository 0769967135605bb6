"""The summary of `edgevpr match`."""

import math

import numpy as np
import pytest

from edgevpr.cli.matched import format_matches


def make_matches(offsets_m):
    """Accepted queries whose fixes, each good to 5 m, lie so far (east, north) from their GPS tags."""
    fix = {"lat_deg": 50.0, "lon_deg": 8.0, "accuracy_m": 5.0, "on_map_m": 2.0, "of_place": False}
    place = {"number": 1, "image": "1.jpg"}
    first = {"query": "q.jpg", "accepted": True, "score": 0.5, "place": place, "position": fix}
    return [{**first, "gps_tag_offset_m": list(each), "from_gps_tag_m": math.hypot(*each)} for each in offsets_m]


@pytest.mark.parametrize(
    ("east_m", "scatter_m", "count", "is_reported"),
    [(40, 3, 8, True), (40, 3, 4, False), (8, 1, 8, False), (40, 40, 8, False)],
    ids=["alike", "too few", "within the claim", "scattered"],
)
def test_format_matches_reports_fixes_that_all_lie_off_their_tags_alike(east_m, scatter_m, count, is_reported):
    offsets_m = np.random.default_rng(3).normal((east_m, -5.0), scatter_m, (count, 2))
    said = "\n".join(format_matches(make_matches(offsets_m)))
    assert ("map or tags are displaced" in said) == is_reported
    assert ("m east and" in said) == is_reported


@pytest.mark.parametrize("others", [[(0, 0)] * 4, [(-300, 0)] * 7])
def test_format_matches_reports_no_offset_that_many_do_not_have(others):
    assert "displaced" not in "\n".join(format_matches(make_matches([*[(40, 0)] * 8, *others])))


def test_format_matches_needs_no_tags():
    untagged = [{**match, "gps_tag_offset_m": None, "from_gps_tag_m": None} for match in make_matches([(40, 0)] * 8)]
    assert "8 queries, 8 accepted" in "\n".join(format_matches(untagged))
