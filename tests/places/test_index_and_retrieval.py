"""The index under its budget, and retrieval over it with techniques that are simple enough to predict."""

import dataclasses
import shutil

import numpy as np
import pytest
from ranking import Ruler, rank

from edgevpr.core.contract import FineMatch
from edgevpr.core.errors import MapError
from edgevpr.core.types import Frame, Position
from edgevpr.places import retrieve
from edgevpr.places.index import compute_place_bytes, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import margin, outside_neighbourhood
from edgevpr.places.retrieve import Query, compute_candidate_factor, load_candidates, match_unmoved_places


@pytest.fixture(scope="module")
def whole_map(tmp_path_factory):
    technique = Ruler()
    path = tmp_path_factory.mktemp("ruler") / "ruler.gpkg"
    with PlaceMap.create(path, technique.spec) as place_map:
        for number in range(0, 100, 4):
            position = Position(0.0, number * 1e-4) if number != 60 else None
            frame = Frame(image=np.zeros((1, 1)), name=f"{number}", t_mono_s=0.0, position=position)
            place_map.add(frame, technique.encode(number))
    return path


@pytest.fixture
def ruler_map(whole_map, tmp_path):
    shutil.copy(whole_map, tmp_path)
    with PlaceMap.open(tmp_path / whole_map.name) as place_map:
        yield Ruler(), place_map


@pytest.fixture
def ruler(ruler_map):
    """A technique, its map, and the index of all places."""
    technique, place_map = ruler_map
    return technique, place_map, load_index(place_map, technique, 10_000)


def test_index_is_contiguous_and_has_the_promised_size(ruler):
    technique, _, index = ruler
    assert len(index) == 25
    assert index.nbytes == 25 * compute_place_bytes(technique.spec)
    assert index.rows.flags.c_contiguous
    assert index.spacing_m() == pytest.approx(44.5, abs=0.1)
    index.lat_deg[1::3], index.lon_deg[1::3] = index.lat_deg[::3][:8], index.lon_deg[::3][:8]
    index.lat_deg[2::3], index.lon_deg[2::3] = index.lat_deg[::3][:8], index.lon_deg[::3][:8]
    assert index.spacing_m() == pytest.approx(3 * 44.5, abs=0.3), "three images at each position"
    index.lat_deg[:], index.lon_deg[:] = 50.0, 8.0
    assert index.spacing_m() == 0.0


def test_load_index_beyond_the_budget_keeps_the_best_places_in_ram_and_all_on_disk(ruler_map, caplog):
    technique, place_map = ruler_map
    each = compute_place_bytes(technique.spec)
    index = load_index(place_map, technique, 25 * each)
    assert len(index) == 25
    assert not caplog.messages
    index = load_index(place_map, technique, 10 * each + 5)
    assert len(index) == 10
    assert index.nbytes <= 10 * each + 5
    assert np.diff(index.place_ids).max() <= 5, "what stays is spread over the whole track"
    assert "10 best" in caplog.messages[0]
    assert len(place_map) == 25
    found = load_candidates(rank(technique, technique.encode(43), place_map, index), index, place_map, 1)
    assert found[0].place.place_id in index.place_ids


def test_load_index_refuses_an_empty_map_and_a_budget_below_one_place(ruler_map, tmp_path):
    technique, place_map = ruler_map
    with pytest.raises(MapError, match="budget"):
        load_index(place_map, technique, compute_place_bytes(technique.spec) - 1)
    with PlaceMap.create(tmp_path / "empty.gpkg", Ruler.spec) as place_map, pytest.raises(MapError, match="is empty"):
        load_index(place_map, Ruler(), 10_000)


def test_retrieve_compares_all_places_without_a_limit_of_candidates(ruler):
    technique, place_map, index = ruler
    query = technique.encode(43)
    everything = rank(technique, query, place_map, index)
    assert technique.compared == 25
    assert [c.place.source_image for c in load_candidates(everything, index, place_map, 3)] == ["44", "40", "48"]
    technique.compared = 0
    few = load_candidates(rank(technique, query, place_map, index, candidates=3), index, place_map)
    assert technique.compared == 3
    assert {c.place.source_image for c in few} == {"36", "40", "44"}  # those that round to 40
    assert few[0].place.source_image == "44"


def test_margin_is_to_the_best_place_elsewhere(ruler):
    technique, place_map, index = ruler
    ranking = rank(technique, technique.encode(20), place_map, index)
    # 11 m a number: 16 and 24 are 44 m away, 12 and 28 are 89 m.
    assert margin(ranking, index, 40.0) == pytest.approx(1 - 1 / 5)
    assert margin(ranking, index, 50.0) == pytest.approx(1 - 1 / 9)
    assert margin(ranking, index, 1e6) == pytest.approx(1 - 1 / 41), (
        "only the place without a position is outside_neighbourhood"
    )
    nowhere = rank(technique, technique.encode(60), place_map, index)
    assert margin(nowhere, index, 1e6) == pytest.approx(1 - 1 / 13), "without a position, neighbours are the two beside"


def reach_only(index, *numbers):
    """Only the places of these numbers are in reach."""
    return np.isin(index.place_ids, [1 + number // 4 for number in numbers])


def test_places_out_of_reach_are_no_candidates(ruler):
    technique, place_map, index = ruler
    query = technique.encode(43)
    allowed = reach_only(index, *range(64, 100, 4))
    technique.compared = 0
    ranking = rank(technique, query, place_map, index, candidates=3, in_reach=allowed)
    assert technique.compared == 3 + 5, "three in reach, and the five best-scanned of all others"
    found = {c.place.source_image for c in load_candidates(ranking, index, place_map)}
    assert {"64", "68", "72"} <= found, "in reach, the nearest to what the picture shows"
    # A false position must not hide the right place behind the best of the wrong ones.
    assert load_candidates(ranking, index, place_map, 1)[0].place.source_image == "44"


def test_retrieve_finds_rivals_in_the_whole_map_for_a_single_place_in_reach(ruler):
    technique, place_map, index = ruler
    alone = rank(technique, technique.encode(20), place_map, index, 20, 40.0, reach_only(index, 80))
    assert len(alone.slots) == 1 + 5
    # The picture shows another place: the one in reach must not be taken for want of it.
    assert load_candidates(alone, index, place_map, 1)[0].place.source_image == "20"
    assert margin(alone, index, 40.0) == pytest.approx(1 - 1 / 5)
    right = rank(technique, technique.encode(80), place_map, index, 20, 40.0, reach_only(index, 80))
    assert load_candidates(right, index, place_map, 1)[0].place.source_image == "80"
    assert margin(right, index, 40.0) == pytest.approx(1 - 1 / 5)


def test_index_keeps_headings_and_finds_places_within_a_distance(tmp_path):
    technique = Ruler()
    headings = (0.0, 359.99, 123.4, None, -90.0, 720.5)
    with PlaceMap.create(tmp_path / "turned.gpkg", technique.spec) as place_map:
        for number, heading_deg in enumerate(headings):
            position = Position(0.0, 179.9995 + number * 1e-3 - 360 * (number > 0)) if number < 5 else None
            frame = Frame(image=None, name="", t_mono_s=0.0, position=position, heading_deg=heading_deg)
            place_map.add(frame, technique.encode(0))
        index = load_index(place_map, technique, 10_000)
    expected = [0.0, 359.99, 123.4, np.nan, 270.0, 0.5]
    np.testing.assert_allclose(index.heading_deg, expected, atol=0.13)  # half a step of half precision
    assert index.find_within(Position(0.0, -179.999), 120.0).tolist() == [False, True, True, False, False, False]
    assert index.find_within(Position(0.0, -179.999), 180.0).tolist() == [True, True, True, True, False, False]


class RotatedRuler(Ruler):
    """A ruler that may have been turned in three ways, of which only the last one matches."""

    def __init__(self):
        self.tried = []

    def score_places(self, query, rows, mean):
        scores, _ = super().score_places(query, rows, mean)
        return scores, np.stack([scores / 3, scores / 2, scores], axis=1)

    def match(self, query, fine, hypotheses):
        self.tried.append(hypotheses)
        found = super().match(query, fine, hypotheses)
        return found if hypotheses is None or 2 in hypotheses else FineMatch(0.0)


def test_match_gets_the_chosen_hypotheses_or_all_of_them(ruler):
    _, place_map, index = ruler
    technique = RotatedRuler()
    query = technique.encode(43)
    few = rank(technique, query, place_map, index, 14)
    assert sum(len(hypotheses) for hypotheses in technique.tried) == 14
    assert len(few.slots) > 4
    assert [2] in technique.tried
    technique.tried.clear()
    everything = rank(technique, query, place_map, index)
    assert technique.tried == [None] * 25
    assert few.slots[0] == everything.slots[0]
    assert few.scores[0] == everything.scores[0]


@pytest.mark.parametrize(
    ("large", "known", "compared"),
    [
        (25, {}, 22),
        (26, {}, 14),
        (25, {"rotation_deg": np.zeros(25)}, 14),
        (25, {"in_reach": np.arange(25) < 24}, 14 + 3),
    ],
    ids=["a large map", "a small map", "known headings", "few in reach"],
)
def test_retrieve_compares_more_places_of_a_large_map_without_a_heading(ruler_map, monkeypatch, large, known, compared):
    class Tall(RotatedRuler):
        spec = dataclasses.replace(Ruler.spec, height_ratios=(1.0,))

        def score_places(self, query, rows, mean, **hints):
            return super().score_places(query, rows, mean)

    monkeypatch.setattr(retrieve, "_LARGE_MAP_PLACES", large)
    _, place_map = ruler_map
    technique = Tall()
    rank(technique, technique.encode(43), place_map, load_index(place_map, technique, 10_000), 14, **known)
    assert sum(len(hypotheses) for hypotheses in technique.tried) == compared


def test_retrieve_compares_more_places_from_two_thousand_on():
    assert [compute_candidate_factor(True, places) for places in (1999, 2000)] == [1, 1.6]
    assert compute_candidate_factor(False, 2000) == 1


def test_ranking_counts_the_rotations_not_ruled_out(ruler_map):
    _, place_map = ruler_map

    class Known(RotatedRuler):
        def score_places(self, query, rows, mean):
            scores, each = super().score_places(query, rows, mean)
            return scores, np.where([True, False, True], each, -np.inf)

    class Tall(RotatedRuler):
        """Of places with an odd number, one of two rotations at one of two heights is left."""

        spec = dataclasses.replace(Ruler.spec, height_ratios=(0.8, 1.0))

        def score_places(self, query, rows, mean, **hints):
            scores, _ = Ruler.score_places(self, query, rows, mean)
            is_left = np.ones((len(rows), 4), bool)
            is_left[1::2, 1:] = False
            return scores, np.where(is_left, scores[:, None], -np.inf)

    for technique, tried in ((RotatedRuler(), 1.0), (Known(), 2 / 3), (Ruler(), 1.0), (Tall(), 0.75)):
        index = load_index(place_map, technique, 10_000)
        assert rank(technique, technique.encode(43), place_map, index, 14).tried == pytest.approx(tried)


class BiasedQuickRuler(Ruler):
    """A ruler with wrong first impressions: at a glance each number is five larger than it is."""

    spec = dataclasses.replace(Ruler.spec, max_matches=3)

    def __init__(self):
        self.glanced = []

    def score_quickly(self, query, fine, hypotheses):
        self.glanced.append(float(fine[0]))
        return 1 / (1 + abs(float(fine[0]) + 5 - float(query.fine[0]))), hypotheses


def test_retrieve_matches_the_candidates_with_the_best_quick_scores(ruler):
    _, place_map, index = ruler
    technique = BiasedQuickRuler()
    ranking = rank(technique, technique.encode(41), place_map, index, 8, 5.0)
    assert len(technique.glanced) == 8
    assert technique.compared == 3
    names = [c.place.source_image for c in load_candidates(ranking, index, place_map)]
    assert names[:3] == ["40", "36", "32"]
    assert len(names) == 8, "the others come last, as they looked"
    assert set(ranking.compared) == set(ranking.slots[:3].tolist())
    whole = [load_candidates(ranking, index, place_map)[number].match for number in (0, -1)]
    assert whole == [ranking.compared[ranking.slots[0]], FineMatch(float(ranking.scores[-1]))]
    assert (np.diff(ranking.scores) <= 0).all()


def test_retrieve_compares_a_rival_with_the_best_quick_score_elsewhere(ruler):
    _, place_map, index = ruler
    technique = BiasedQuickRuler()
    # All three that are compared are neighbours, within 150 m of 40: so five rivals are compared as well.
    ranking = rank(technique, technique.encode(41), place_map, index, 12, 150.0)
    assert technique.compared == 8
    away = outside_neighbourhood(index, ranking.slots[0], ranking.slots, 150.0)
    rivals = [slot for slot in ranking.slots[away].tolist() if slot in ranking.compared]
    seen = {number: 1 / (1 + abs(number + 5 - 41)) for number in technique.glanced}
    assert len(rivals) == 5
    numbers = {4.0 * slot for slot in rivals}
    others = [score for number, score in seen.items() if number not in numbers and abs(number - 40) * 11.1 > 150]
    assert min(seen[number] for number in numbers) >= max(others, default=0)


@pytest.mark.parametrize("candidates", [3, None])
def test_retrieve_includes_the_scan_score_if_the_scan_counts(ruler, candidates):
    technique, place_map, index = ruler
    query = technique.encode(43)
    plain = rank(technique, query, place_map, index, candidates)
    scanned, _ = technique.score_places(query, index.rows, index.mean)
    technique.spec = dataclasses.replace(technique.spec, scan_counts=True)
    ranking = rank(technique, query, place_map, index, candidates)
    assert sorted(ranking.slots) == sorted(plain.slots)
    compared = dict(zip(plain.slots.tolist(), plain.scores.tolist(), strict=True))
    expected = [compared[slot] * (1 + scanned[slot]) / 2 for slot in ranking.slots.tolist()]
    np.testing.assert_allclose(ranking.scores, expected, rtol=1e-6)
    assert (np.diff(ranking.scores) <= 0).all()
    assert [ranking.compared[slot].score for slot in ranking.slots.tolist()] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("usual", "candidates", "glanced", "compared"), [(20, 25, 0, 25), (25, 25, 25, 3), (20, 24, 24, 3), (20, 3, 0, 3)]
)
def test_retrieve_skips_quick_scores_if_few_places_are_compared(ruler, usual, candidates, glanced, compared):
    _, place_map, index = ruler
    technique = BiasedQuickRuler()
    technique.candidates = usual
    rank(technique, technique.encode(41), place_map, index, candidates)
    assert (len(technique.glanced), technique.compared) == (glanced, compared)


def test_retrieve_compares_five_places_out_of_reach_with_few_candidates(ruler):
    _, place_map, index = ruler
    technique = BiasedQuickRuler()
    rank(technique, technique.encode(41), place_map, index, 8, in_reach=reach_only(index, *range(0, 60, 4)))
    assert technique.compared == 3 + 5


@pytest.mark.parametrize(
    ("candidates", "apart_m", "reach", "compared"),
    [(3, 60.0, None, 3 + 5), (2, 40.0, None, 2), (3, 40.0, None, 3), (3, 60.0, (80,), 1 + 5 + 2)],
)
def test_retrieve_compares_rivals_if_no_candidate_is_one(ruler, candidates, apart_m, reach, compared):
    technique, place_map, index = ruler
    in_reach = reach and reach_only(index, *reach)
    ranking = rank(technique, technique.encode(41), place_map, index, candidates, apart_m, in_reach)
    assert len(ranking.slots) == technique.compared == compared


class UnmovedRuler(Ruler):
    def match_at_rest(self, query, fine):
        return FineMatch(float(fine[0]))


def test_match_unmoved_places_compares_a_few_places_across_the_map(ruler):
    _, place_map, index = ruler
    technique = UnmovedRuler()
    query = Query(technique=technique, descriptor=technique.encode(0), place_map=place_map, index=index)
    place_map.left_out[25] = "gone"
    for apart_m, numbers in ((200.0, range(20, 96, 12)), (250.0, range(24, 96, 8))):
        asked = [match.score for match in match_unmoved_places(query, 0, apart_m)]
        assert asked == list(numbers), "of 19 and 18 places that can be read nine at most"
    place_map.left_out[16] = "gone"
    assert match_unmoved_places(query, 0, 1e6) == [], "the only one outside_neighbourhood cannot be read"
    assert match_unmoved_places(query, 15, 1e6)[0].score == 0.0, "only neighbours of one without a position"
