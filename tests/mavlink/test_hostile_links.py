"""A short form of the hostile links of `benchmarks/hostile_links.py`: nothing leaves for another, and nothing late."""

import hostile_links


def test_no_hostile_link_gets_a_fix_that_is_not_its_own_or_a_late_one():
    rows = hostile_links.run(count=80, seed=11)
    assert [(row.kind, row.foreign, row.late, row.exceptions) for row in rows] == [(row.kind, 0, 0, 0) for row in rows]
    assert all(row.left for row in rows), "ours got none, so nothing was tried"
    silent = next(row for row in rows if row.kind == "reads nothing for 60 s (usual buffer)")
    assert (silent.fixes, silent.left <= 10) == (180, True), "five, and one every ten seconds"
