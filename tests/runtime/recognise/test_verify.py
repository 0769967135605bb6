"""Verification in the walk of a frame: what landmarks refuse and accept, and maps that have none or damaged ones."""

import math
import shutil
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fixed_confidence import make_model, make_rule, rate_landmarks
from map_writer import write_sql
from unreal_pictures import overlay_figures
from walks import make_map, walk_over

from edgevpr.core.reasons import ReasonCode
from edgevpr.core.types import Frame, Position
from edgevpr.frames.mask import OverlayMask
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.sequence import SequenceSearch
from edgevpr.runtime.recognise.decide import MatchSettings, Verifier
from edgevpr.runtime.recognise.judge import AcceptRule
from edgevpr.runtime.recognise.landmarks import detect_landmarks, pack_bytes, unpack_bytes
from edgevpr.runtime.recognise.recognition import to_fields
from edgevpr.techniques import create

pytestmark = pytest.mark.slow

PLACES = 4
RULE = AcceptRule(min_score=0.08, min_margin=0.03, neighbour_m=50.0)
BY_LANDMARKS = make_rule(rate_landmarks)


def ground(seed):
    """Ground larger than a picture, with patches of all sizes."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.normal(size=(300, 380)), (0, 0), size) * size for size in (1, 2, 4, 8)]
    return cv2.normalize(sum(layers), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def frame(seed, right_px=0, down_px=0):
    image = np.ascontiguousarray(ground(seed)[30 + down_px : 270 + down_px, 30 + right_px : 350 + right_px])
    return Frame(image=image, name=f"{seed}.png", t_mono_s=0.0, position=Position(50 + seed * 0.001, 8.0))


@pytest.fixture(scope="module")
def technique():
    return create("cohog", {"camera": "nadir"})


@pytest.fixture(scope="module")
def shared_map(tmp_path_factory, technique):
    return make_map(tmp_path_factory.mktemp("map") / "m.gpkg", technique, map(frame, range(PLACES)))


@pytest.fixture
def map_copy(shared_map, tmp_path):
    """A copy of the map, to be changed."""
    return Path(shutil.copy(shared_map, tmp_path))


def store(path, landmarks, checksum):
    """Write other landmarks for the second place."""
    blob, number = ("NULL", "NULL") if landmarks is None else (f"x'{landmarks.hex()}'", checksum)
    write_sql(path, f"UPDATE places SET landmarks = {blob}, landmarks_crc32 = {number} WHERE place_id = 2")


def run_query(path, technique, query, rule=RULE, times=1, search=None):
    """The event of a query; of the last, where it is asked several times."""
    with PlaceMap.open(path) as place_map:
        walk = walk_over(place_map, technique, rule, search, settings=MatchSettings(candidates=technique.candidates))
        return [walk.step(query) for _ in range(times)][-1]


def test_verify_finds_the_landmarks_of_a_downward_map(map_copy, technique):
    event = run_query(map_copy, technique, frame(1, 20, -10), BY_LANDMARKS)
    assert event.accepted
    assert event.reason.parameters["landmarks"] == event.agreement.inliers
    assert event.agreement.inliers >= 10
    assert np.array(event.agreement.shift_share) * 320 == pytest.approx((20, -10), abs=1.5)
    said = to_fields(event)["landmarks"]
    assert (said["inliers"], said["scale"]) == (event.agreement.inliers, pytest.approx(1, abs=0.02))


@pytest.fixture(scope="module")
def forward_map(tmp_path_factory):
    """A map made by a camera that looks ahead, of pictures twice as wide as high."""
    return make_map(tmp_path_factory.mktemp("ahead") / "m.gpkg", create("cohog"), map(crop_wide, range(PLACES)))


def crop_wide(seed, right_px=0, down_px=0):
    cut = frame(seed, right_px, down_px)
    return replace(cut, image=cut.image[:160])


def read_proof(path, confidence, of_map=1.0, moved_px=(10, -16)):
    """What landmarks say of a query of the second place, whose match is so sure without them."""
    rule = make_rule(lambda evidence: confidence)
    rule = replace(rule, confidence_rule=make_model(lambda evidence: confidence, lambda evidence: of_map))
    event = run_query(path, create("cohog"), crop_wide(1, *moved_px), rule)
    assert event.agreement is None, "they never speak against a match"
    assert event.best.place.place_id == 2
    return event.evidence.proof


def test_verify_uses_landmarks_of_a_forward_camera_if_the_match_is_uncertain(forward_map):
    assert read_proof(forward_map, 0.5) > math.log(2)
    assert read_proof(forward_map, 0.95) == 0, "it is sure"
    assert read_proof(forward_map, 0.5, of_map=0.1) == 0, "they would not tell that it is on the map"
    assert read_proof(forward_map, 0.5, moved_px=(0, 0)) == 0, "a display drawn over every picture agrees as well"


def test_verify_refuses_a_clear_match_with_landmarks_of_another_image(map_copy, technique):
    others = pack_bytes(detect_landmarks(frame(77).image))
    store(map_copy, others, zlib.crc32(others))
    event = run_query(map_copy, technique, frame(1, 20, -10))
    assert event.best.match.score > 0.2
    assert (event.accepted, event.failed, event.position) == (False, False, None)
    assert event.reason.code is ReasonCode.FEW_LANDMARKS
    assert run_query(map_copy, technique, frame(2, 20, -10)).accepted, "the other places are as they were"


def test_verify_refuses_a_place_whose_landmarks_and_regions_disagree(map_copy, technique):
    turned = pack_bytes(detect_landmarks(np.ascontiguousarray(np.rot90(frame(1).image, 2))))
    store(map_copy, turned, zlib.crc32(turned))
    event = run_query(map_copy, technique, frame(1, 20, -10))
    assert not event.accepted
    assert event.reason.code is ReasonCode.LANDMARKS_DISAGREE


def draw_figures(image):
    return overlay_figures(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.random.default_rng(3))


def test_verify_detects_an_overlay_by_unshifted_matches_of_other_places(tmp_path, map_copy, technique):
    anything = make_rule(lambda evidence: 1.0)
    drawn = [replace(frame(place), image=draw_figures(frame(place).image)) for place in range(PLACES)]
    path = make_map(tmp_path / "drawn.gpkg", technique, drawn)
    changed = cv2.addWeighted(frame(1).image, 0.3, frame(7).image, 0.7, 0)
    at_rest = run_query(path, technique, replace(frame(1), image=draw_figures(changed)), anything)
    assert (at_rest.accepted, at_rest.position) == (False, None)
    assert at_rest.reason.code is ReasonCode.ELSEWHERE_AT_REST
    assert run_query(map_copy, technique, replace(frame(1), image=changed), anything).accepted, "without a display"
    assert run_query(path, technique, drawn[1], anything).accepted, "its ground agrees much better than the figures"
    moved = replace(drawn[1], image=draw_figures(frame(1, 20, -10).image))
    assert run_query(path, technique, moved, anything).accepted


def move_far(image):
    return Frame(image=image, name="again.png", t_mono_s=0.0, position=Position(51.0, 8.0))


def test_verify_gives_ground_mapped_twice_at_most_an_even_chance(tmp_path, technique):
    path = make_map(tmp_path / "m.gpkg", technique, [*map(frame, range(PLACES)), move_far(frame(1).image)])
    event = run_query(path, technique, frame(1, 20, -10), BY_LANDMARKS)
    assert (event.accepted, event.confidence) == (False, 0.5)


@pytest.mark.parametrize("has_landmarks", [True, False])
def test_verify_does_not_accept_nearly_duplicate_ground_by_landmarks(tmp_path, technique, has_landmarks):
    """A place elsewhere without landmarks may be the right one as well."""
    changed = frame(1).image.copy()
    changed[:, :80] = frame(9).image[:, :80]
    path = make_map(tmp_path / "m.gpkg", technique, [*map(frame, range(PLACES)), move_far(changed)])
    if not has_landmarks:
        write_sql(path, "UPDATE places SET landmarks = NULL, landmarks_crc32 = NULL WHERE place_id != 2")
    event = run_query(path, technique, frame(1, 20, -10), BY_LANDMARKS)
    assert event.best.place.source_image == "1.png"
    assert not event.accepted
    assert event.reason.code is ReasonCode.LOOKS_ALIKE


def make_bare_frame(seed, right_px=0, down_px=0):
    return replace(frame(seed, right_px, down_px), position=None)


@pytest.fixture(scope="module")
def overlapping(tmp_path_factory, technique):
    """Places without positions: the first, the fifth and the eighth show the same ground."""
    same, other = (
        [make_bare_frame(1, -25, -10), make_bare_frame(1, 25, 10), make_bare_frame(1, 0, 28)],
        list(map(make_bare_frame, range(2, 7))),
    )
    order = [same[0], *other[:3], same[1], *other[3:], same[2]]
    return make_map(tmp_path_factory.mktemp("overlapping") / "m.gpkg", technique, order)


def find_same_ground(path, technique, query):
    """The best place of a query, and the numbers of the places that show the same ground."""
    with PlaceMap.open(path) as place_map:
        walk = walk_over(place_map, technique, BY_LANDMARKS, settings=MatchSettings())
        event = walk.step(query)
        looked = Verifier(walk.encoder, event.picture, walk.index, place_map)
        return event, int(walk.index.place_ids[event.ranking.slots[0]]), set(looked.find_same_ground(event.ranking))


def test_verify_treats_overlapping_places_without_positions_as_the_same_ground(overlapping, technique):
    for query in (make_bare_frame(1, 3, 2), make_bare_frame(1, -15, 5)):
        event, best, same = find_same_ground(overlapping, technique, query)
        assert {best, *same} == {1, 5, 8}
        assert event.accepted
        assert event.evidence.lead > math.log(1.5), "places of the same ground are no rivals"


@pytest.mark.parametrize(
    "blob", [None, b"", b"\x09of a newer form", pack_bytes(detect_landmarks(np.zeros((9, 9), np.uint8)))]
)
def test_verify_judges_a_place_without_landmarks_as_before(map_copy, technique, blob):
    store(map_copy, None, None)
    without = run_query(map_copy, technique, frame(1, 20, -10))
    store(map_copy, blob, None if blob is None else zlib.crc32(blob))
    event = run_query(map_copy, technique, frame(1, 20, -10))
    assert (event.accepted, event.best, without.accepted) == (True, without.best, True)
    assert event.agreement is None or event.agreement.inliers == 0
    assert without.agreement is None
    assert "landmarks" not in to_fields(without)


def test_verify_refuses_damaged_landmarks_and_leaves_the_place_out(map_copy, technique):
    store(map_copy, b"damaged", 1)
    event = run_query(map_copy, technique, frame(1, 20, -10))
    assert (event.accepted, event.failed, event.map_lost) == (False, True, False)
    assert event.reason.code is ReasonCode.PLACE_UNREADABLE
    ((place_id, problem),) = event.left_out
    assert (place_id, "landmarks" in problem) == (2, True)
    again = run_query(map_copy, technique, frame(1, 20, -10), times=2)
    assert (again.accepted, again.failed) == (False, False)
    assert again.reason.code in (ReasonCode.PLACE_UNREAD, ReasonCode.LOW_SCORE)


def test_verify_applies_the_mask_to_landmarks(shared_map, technique, tmp_path):
    allowed = np.ones((240, 320), bool)
    allowed[:, :160] = False
    path = make_map(tmp_path / "half.gpkg", technique, [frame(1)], mask=OverlayMask(allowed, "half"))
    with PlaceMap.open(path) as place_map:
        there = unpack_bytes(place_map.read_landmarks(1))
    assert len(there) > 30
    assert there.points[:, 0].min() > 0


def test_verify_skips_landmarks_of_a_sequence(map_copy, technique):
    assert run_query(map_copy, technique, frame(1, 20, -10), times=3, search=SequenceSearch(2)).agreement is None
