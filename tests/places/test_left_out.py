"""A place that cannot be read is left out, and this never makes a wrong match look right."""

import dataclasses
import shutil

import numpy as np
import pytest
from ranking import Ruler, rank

from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.reasons import ReasonCode
from edgevpr.core.types import Frame, Position
from edgevpr.places.geopackage import encode_point
from edgevpr.places.index import load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import margin
from edgevpr.places.retrieve import load_candidates
from edgevpr.runtime.recognise.judge import AcceptRule, Findings, judge

RULE = AcceptRule(min_score=0.1, min_margin=0.1, neighbour_m=20.0)


class SingleStageRuler(Ruler):
    """The same of one stage: a place is ranked by its row alone."""

    spec = dataclasses.replace(Ruler.spec, fine=None)


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """A map of each technique: the places 0, 10, ... 290, 111 m apart. Their ids are 1 to 30."""
    folder = tmp_path_factory.mktemp("maps")
    for technique in (Ruler(), SingleStageRuler()):
        with PlaceMap.create(folder / type(technique).__name__, technique.spec) as place_map:
            for number in range(0, 300, 10):
                position = Position(number * 1e-4, 0.0)
                frame = Frame(image=np.zeros((1, 1)), name=f"{number}", t_mono_s=0.0, position=position)
                place_map.add(frame, technique.encode(number))
    return folder


def open_index(technique, maps, tmp_path):
    """A technique, its map, and the index."""
    with PlaceMap.open_for_writing(shutil.copy(maps / type(technique).__name__, tmp_path / "m.gpkg")) as place_map:
        yield technique, place_map, load_index(place_map, technique, 10_000)


@pytest.fixture
def ruler(maps, tmp_path):
    yield from open_index(Ruler(), maps, tmp_path)


@pytest.fixture
def single_stage(maps, tmp_path):
    yield from open_index(SingleStageRuler(), maps, tmp_path)


def damage(place_map, change, *numbers):
    for number in numbers:
        place_map.db.execute(f"UPDATE places SET {change} WHERE place_id = ?", (1 + number // 10,))


DAMAGE = {
    "fine = x'00'": "its fine part has the wrong size",
    "fine = zeroblob(8)": "its fine part does not match its checksum",
    "fine_crc32 = 1": "its fine part does not match its checksum",
    "fine_crc32 = 'x'": "its fine part does not match its checksum",
    "fine = NULL": "its fine part has the wrong size",
    "fine = 7": "its fine part has the wrong size",
    "fine = x'000000000000f07f', fine_crc32 = NULL": "its fine part is not finite",
    f"geom = x'{encode_point(1.0, 1.0).hex()}'": "its position has changed",
    "geom = NULL": "its position has changed",
    "geom = 'text'": "its geometry is not a point",
    "place_id = 1000": "its row is missing",
}


@pytest.mark.parametrize("change", DAMAGE)
def test_retrieve_refuses_the_first_query_at_a_damaged_place_and_then_excludes_it(ruler, change):
    technique, place_map, index = ruler
    damage(place_map, change, 100)
    query = technique.encode(142)
    with pytest.raises(PlaceError, match="place 11"):
        rank(technique, query, place_map, index, candidates=10)
    assert place_map.left_out == {11: DAMAGE[change]}
    ranking = rank(technique, query, place_map, index, candidates=10)
    assert 10 not in ranking.slots
    assert len(ranking.slots) == 10, "the next best takes its turn"
    assert load_candidates(ranking, index, place_map, 1)[0].place.source_image == "140"
    assert not len(ranking.unread)
    assert judge(Findings(ranking), index, RULE).accepted


def test_judge_accepts_no_other_place_while_the_correct_one_is_unreadable(ruler):
    """The query shows place 100, with a neighbour 111 m on that looks nearly like it: alone, the neighbour is ahead."""
    technique, place_map, index = ruler
    query, rule = technique.encode(104), dataclasses.replace(RULE, min_margin=0.01)
    assert judge(Findings(rank(technique, query, place_map, index)), index, rule).accepted
    damage(place_map, "fine = x'00'", 100)
    with pytest.raises(PlaceError):
        rank(technique, query, place_map, index)
    ranking = rank(technique, query, place_map, index)
    assert load_candidates(ranking, index, place_map, 1)[0].place.source_image == "110"
    bare = dataclasses.replace(ranking, unread=np.empty(0, np.intp))
    assert judge(Findings(bare), index, rule).accepted, "but for the rule"
    verdict = judge(Findings(ranking), index, rule)
    assert (verdict.accepted, verdict.reason.code) == (False, ReasonCode.PLACE_UNREAD)


@pytest.mark.parametrize(
    ("shown", "number", "may_be_right"),
    [
        *[(101, number, True) for number in (90, 100, 110)],
        *[(101, number, False) for number in (80, 120)],
        (138, 70, True),  # its row is nearer to the query's than that of 140, which is the best place
        (138, 60, False),
    ],
)
def test_place_left_out_may_be_correct_if_its_row_is_as_similar_as_the_best_or_in_the_top_three(
    ruler, shown, number, may_be_right
):
    technique, place_map, index = ruler
    place_map.left_out[1 + number // 10] = "gone"
    query = dataclasses.replace(technique.encode(shown), coarse=np.array([101], "<f4"))
    assert (number // 10 in rank(technique, query, place_map, index).unread) is may_be_right


def test_retrieve_blames_the_file_if_most_places_are_unreadable_and_restores_all_with_it(ruler):
    technique, place_map, index = ruler
    fine = place_map.db.execute("SELECT fine, place_id FROM places").fetchall()
    place_map.db.execute("UPDATE places SET fine = x'00'")
    for _ in range(2):
        with pytest.raises(MapError, match=r"\b30 .* 30 ") as caught:
            rank(technique, technique.encode(142), place_map, index)
        assert not isinstance(caught.value, PlaceError)
        assert not place_map.left_out
    place_map.db.executemany("UPDATE places SET fine = ? WHERE place_id = ?", fine)
    assert rank(technique, technique.encode(142), place_map, index).slots[0] == 14


@pytest.mark.parametrize(
    ("damaged", "candidates", "error"),
    [((140, 130), 3, PlaceError), ((140, 130, 150), 5, MapError), ((140, 130, 150), 6, PlaceError)],
)
def test_retrieve_blames_the_file_if_three_and_most_places_are_unreadable(ruler, damaged, candidates, error):
    technique, place_map, index = ruler
    damage(place_map, "fine = x'00'", *damaged)
    with pytest.raises(MapError) as caught:
        rank(technique, technique.encode(142), place_map, index, candidates)
    assert type(caught.value) is error
    assert getattr(caught.value, "place_id", 14) == 14
    assert len(place_map.left_out) == (len(damaged) if error is PlaceError else 0)


def test_retrieve_finds_rivals_among_readable_places(ruler):
    technique, place_map, index = ruler
    place_map.left_out.update({16: "gone", 14: "gone"})
    ranking = rank(technique, technique.encode(142), place_map, index, candidates=1, apart_m=200.0)
    assert not {13, 15} & set(ranking.slots.tolist())
    assert margin(ranking, index, 200.0) is not None


def test_single_stage_place_left_out_stays_a_rival_but_is_never_returned(single_stage):
    technique, place_map, index = single_stage
    damage(place_map, f"geom = x'{encode_point(1.0, 1.0).hex()}'", 140)
    ranking = rank(technique, technique.encode(142), place_map, index)
    with pytest.raises(PlaceError, match="position"):
        load_candidates(ranking, index, place_map, 1)
    again = rank(technique, technique.encode(142), place_map, index)
    np.testing.assert_array_equal(again.scores, ranking.scores)
    assert len(rank(technique, technique.encode(142), place_map, index, 3).slots) == 30, "rows are all there is"
    with pytest.raises(PlaceError, match="place 15"):
        load_candidates(again, index, place_map, 1)
    other = rank(technique, technique.encode(132), place_map, index)
    assert 14 in other.slots
    assert load_candidates(other, index, place_map, 1)[0].place.source_image == "130"
    assert list(place_map.left_out) == [15]
