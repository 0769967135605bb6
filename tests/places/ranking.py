"""A technique that is simple enough to predict, and one call for both stages of retrieval."""

import numpy as np

from edgevpr.core.contract import Descriptor, FineMatch, PartSpec, TechniqueSpec
from edgevpr.places.index import PlaceIndex, allocate_index
from edgevpr.places.ranking import Ranking
from edgevpr.places.retrieve import Expectation, Query, compare_places, scan_index


class Ruler:
    """Places are numbers: the coarse part is the number to the nearest 10, the fine part the number itself."""

    spec = TechniqueSpec(name="ruler", parameters={}, coarse=PartSpec((1,), "<f4"), fine=PartSpec((1,), "<f8"))
    min_score = min_margin = 0.0
    candidates = 20
    compared = 0

    def encode(self, number):
        return Descriptor(coarse=np.array([round(number, -1)], "<f4"), fine=np.array([float(number)]))

    def score_places(self, query, rows, mean):
        return 1 / (1 + abs(rows[:, 0] - query.coarse[0])), None

    def match(self, query, fine, hypotheses):
        self.compared += 1
        return FineMatch(1 / (1 + abs(float(fine[0] - query.fine[0]))))


def rank(technique, query, place_map, index, candidates=None, apart_m=0.0, in_reach=None, rotation_deg=None) -> Ranking:
    """Scan all places, and compare `candidates` of them in full."""
    expected = Expectation(in_reach, rotation_deg)
    asked = Query(technique=technique, descriptor=query, place_map=place_map, index=index, expected=expected)
    return compare_places(asked, scan_index(asked), candidates, apart_m)


def make_index(place_ids) -> PlaceIndex:
    """An index of these places, somewhere."""
    index = allocate_index(Ruler.spec, len(place_ids), None)
    index.place_ids[:] = place_ids
    return index
