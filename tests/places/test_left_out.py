"""A place that cannot be read is left out, and this never makes a wrong match look right."""

import dataclasses
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from ranking import rank

from edgevpr.core.contract import Descriptor, FineMatch, PartSpec, TechniqueSpec
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.types import Frame, Position
from edgevpr.frames.images import read_image
from edgevpr.lab.evaluate.dataset import load_dataset
from edgevpr.places.geopackage import point_blob
from edgevpr.places.index import load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import margin, named
from edgevpr.runtime.recognise.judge import AcceptRule, Findings, judge
from edgevpr.techniques import create

RULE = AcceptRule(min_score=0.1, min_margin=0.1, neighbour_m=20.0)


class Ruler:
    """Places are numbers: the coarse part is the number to the nearest 10, the fine part the number itself."""

    spec = TechniqueSpec(name="ruler", parameters={}, coarse=PartSpec((1,), "<f4"), fine=PartSpec((1,), "<f8"))
    min_score = min_margin = 0.0
    candidates = 10

    def encode(self, number):
        return Descriptor(coarse=np.array([round(number, -1)], "<f4"), fine=np.array([float(number)]))

    def coarse_scores(self, query, rows, mean):
        return 1 / (1 + abs(rows[:, 0] - query.coarse[0])), None

    def match(self, query, fine, hypotheses):
        return FineMatch(1 / (1 + abs(float(fine[0] - query.fine[0]))))


class Short(Ruler):
    """The same of one stage: a place is ranked by its row alone."""

    spec = dataclasses.replace(Ruler.spec, fine=None)


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """A map of each technique: the places 0, 10, ... 290, 111 m apart. Their ids are 1 to 30."""
    folder = tmp_path_factory.mktemp("maps")
    for technique in (Ruler(), Short()):
        with PlaceMap.create(folder / type(technique).__name__, technique.spec) as place_map:
            for number in range(0, 300, 10):
                position = Position(number * 1e-4, 0.0)
                frame = Frame(image=np.zeros((1, 1)), name=f"{number}", t_mono_s=0.0, position=position)
                place_map.add(frame, technique.encode(number))
    return folder


def opened(technique, maps, tmp_path):
    """A technique, its map, and the index."""
    path = shutil.copy(maps / type(technique).__name__, tmp_path / "m.gpkg")
    with PlaceMap.open_for_adding(path) as place_map:
        yield technique, place_map, load_index(place_map, technique, 10_000)


@pytest.fixture
def ruler(maps, tmp_path):
    yield from opened(Ruler(), maps, tmp_path)


@pytest.fixture
def short(maps, tmp_path):
    yield from opened(Short(), maps, tmp_path)


def damage(place_map, change, *numbers):
    for number in numbers:
        place_map.db.execute(f"UPDATE places SET {change} WHERE place_id = ?", (1 + number // 10,))


DAMAGE = {
    "fine = x'00'": "its fine part has a wrong size",
    "fine = zeroblob(8)": "its fine part does not match its checksum",
    "fine_crc32 = 1": "its fine part does not match its checksum",
    "fine_crc32 = 'x'": "its fine part does not match its checksum",
    "fine = NULL": "its fine part has a wrong size",
    "fine = 7": "its fine part has a wrong size",
    "fine = x'000000000000f07f', fine_crc32 = NULL": "its fine part is not finite",
    f"geom = x'{point_blob(1.0, 1.0).hex()}'": "its position has changed",
    "geom = NULL": "its position has changed",
    "geom = 'text'": "its geometry is no point",
    "place_id = 1000": "its row is gone",
}


@pytest.mark.parametrize("change", DAMAGE)
def test_the_query_that_meets_a_damaged_place_is_refused_and_the_next_goes_without_it(ruler, change):
    technique, place_map, index = ruler
    damage(place_map, change, 100)
    query = technique.encode(142)
    with pytest.raises(PlaceError, match="place 11"):
        rank(technique, query, place_map, index, candidates=10)
    assert place_map.left_out == {11: DAMAGE[change]}
    ranking = rank(technique, query, place_map, index, candidates=10)
    assert 10 not in ranking.slots
    assert len(ranking.slots) == 10, "the next best takes its turn"
    assert named(ranking, index, place_map, 1)[0].place.source_image == "140"
    assert not len(ranking.unread)
    assert judge(Findings(ranking), index, RULE).accepted


def test_without_the_right_place_no_other_is_accepted(ruler):
    """The query shows place 100, with a neighbour 111 m on that looks nearly like it: alone, the neighbour is ahead."""
    technique, place_map, index = ruler
    query, rule = technique.encode(104), dataclasses.replace(RULE, min_margin=0.01)
    assert judge(Findings(rank(technique, query, place_map, index)), index, rule).accepted
    damage(place_map, "fine = x'00'", 100)
    with pytest.raises(PlaceError):
        rank(technique, query, place_map, index)
    ranking = rank(technique, query, place_map, index)
    assert named(ranking, index, place_map, 1)[0].place.source_image == "110"
    bare = dataclasses.replace(ranking, unread=np.empty(0, np.intp))
    assert judge(Findings(bare), index, rule).accepted, "but for the rule"
    verdict = judge(Findings(ranking), index, rule)
    assert (verdict.accepted, verdict.reason) == (False, "a place that cannot be read may be the right one")


def test_where_most_cannot_be_read_the_file_is_at_fault_and_all_come_back_with_it(ruler):
    technique, place_map, index = ruler
    fine = place_map.db.execute("SELECT fine, place_id FROM places").fetchall()
    place_map.db.execute("UPDATE places SET fine = x'00'")
    for _ in range(2):
        with pytest.raises(MapError, match="30 of the 30") as caught:
            rank(technique, technique.encode(142), place_map, index)
        assert not isinstance(caught.value, PlaceError)
        assert not place_map.left_out
    place_map.db.executemany("UPDATE places SET fine = ? WHERE place_id = ?", fine)
    assert rank(technique, technique.encode(142), place_map, index).slots[0] == 14


def test_rivals_elsewhere_are_found_among_the_places_that_can_be_read(ruler):
    technique, place_map, index = ruler
    place_map.left_out.update({16: "gone", 14: "gone"})
    ranking = rank(technique, technique.encode(142), place_map, index, candidates=1, neighbour_m=200.0)
    assert not {13, 15} & set(ranking.slots.tolist())
    assert margin(ranking, index, 200.0) is not None


def test_of_one_stage_a_place_left_out_is_still_a_rival_and_never_named(short):
    technique, place_map, index = short
    damage(place_map, f"geom = x'{point_blob(1.0, 1.0).hex()}'", 140)
    ranking = rank(technique, technique.encode(142), place_map, index)
    with pytest.raises(PlaceError, match="position"):
        named(ranking, index, place_map, 1)
    again = rank(technique, technique.encode(142), place_map, index)
    np.testing.assert_array_equal(again.scores, ranking.scores)
    with pytest.raises(PlaceError, match="place 15"):
        named(again, index, place_map, 1)
    other = rank(technique, technique.encode(132), place_map, index)
    assert 14 in other.slots
    assert named(other, index, place_map, 1)[0].place.source_image == "130"
    assert list(place_map.left_out) == [15]


CORRIDOR = Path(os.environ.get("EDGEVPR_DATA", Path(__file__).parents[2].parent / "shared" / "data")) / "corridor"
# Queries for which a wrong place, three frames beyond, has the margin to be accepted when the right ones are left out.
DECEIVED = range(58, 68)


@pytest.mark.slow
@pytest.mark.skipif(not CORRIDOR.is_dir(), reason=f"{CORRIDOR} is not there")
def test_on_real_pictures_no_wrong_place_is_accepted_for_want_of_the_right_ones(tmp_path):
    dataset = load_dataset(CORRIDOR / "query", CORRIDOR / "ref", CORRIDOR / "ground_truth.csv")
    technique = create("cohog")
    rule = AcceptRule(min_score=technique.min_score, min_margin=technique.min_margin, neighbour_m=50.0)
    with PlaceMap.create(tmp_path / "m.gpkg", technique.spec) as place_map:
        for name in dataset.references:
            image = read_image(CORRIDOR / "ref" / name)
            place_map.add(Frame(image=image, name=name, t_mono_s=0.0), technique.encode(image))
        index = load_index(place_map, technique, 10**7)
        deceived = 0
        for number in DECEIVED:
            query = dataset.queries[number]
            place_map.left_out = {1 + dataset.references.index(name): "damaged" for name in query.right}
            ranking = rank(technique, technique.encode(read_image(query.path)), place_map, index, technique.candidates)
            assert not judge(Findings(ranking), index, rule).accepted
            bare = dataclasses.replace(ranking, unread=np.empty(0, np.intp))
            deceived += judge(Findings(bare), index, rule).accepted
        assert deceived >= 5, "but for the rule"
