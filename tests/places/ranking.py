"""One call for both stages of retrieval."""

from edgevpr.places.retrieve import Expectation, Query, Ranking, compare, scan


def rank(
    technique, query, place_map, index, candidates=None, neighbour_m=0.0, in_reach=None, turned_deg=None
) -> Ranking:
    """Scan all places, and compare `candidates` of them in full."""
    expected = Expectation(in_reach, turned_deg)
    asked = Query(technique=technique, descriptor=query, place_map=place_map, index=index, expected=expected)
    return compare(asked, scan(asked), candidates, neighbour_m)
