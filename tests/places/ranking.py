"""One call for both stages of retrieval."""

from edgevpr.places.retrieve import Expected, Ranking, compare, scan


def rank(
    technique, query, place_map, index, candidates=None, neighbour_m=0.0, in_reach=None, turned_deg=None
) -> Ranking:
    """Scan all places, and compare `candidates` of them in full."""
    expected = Expected(in_reach, turned_deg)
    scanned = scan(technique, query, index, expected)
    return compare(
        technique,
        query,
        scanned,
        place_map,
        index,
        candidates=candidates,
        neighbour_m=neighbour_m,
        expected=expected,
    )
