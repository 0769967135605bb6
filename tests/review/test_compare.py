"""A flight held against its replay, line by line."""

from edgevpr.review.compare import compare_lines

START = {"kind": "start", "t_mono_s": 1.0, "version": "1"}
QUERIES = [{"kind": "query", "t_mono_s": 2.0 + at, "query": f"{at}.png", "fix": {"sent": True}} for at in range(3)]


def test_compare_lines_lists_differing_fields_and_the_program_separately():
    other = {**QUERIES[1], "fix": {"sent": False}}
    found = compare_lines([START, *QUERIES], [{**START, "version": "2"}, QUERIES[0], other, QUERIES[2]])
    assert (found.alike, found.after, found.program) == (3, 0, {"version": ("1", "2")})
    assert found.others == [{"kind": "query", "t_mono_s": 3.0, "query": "1.png", "fields": {"fix.sent": (True, False)}}]


def test_compare_lines_counts_missing_lines_and_lists_added_ones():
    assert compare_lines([START, *QUERIES], [START, QUERIES[0]]).after == 2
    (added,) = compare_lines([START], [START, QUERIES[0]]).others
    assert (added["query"], added["only_in"]) == ("0.png", "replay")
