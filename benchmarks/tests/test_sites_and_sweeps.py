"""The benchmarks of many sites and of sweeps ask what they say they ask."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from foreign_places import GENERATED, MIRRORED, foreign
from sites import chosen, covering
from sweep_changes import view

from edgevpr.lab.evaluate.dataset import Dataset, ScoredQuery

SIZE = (320, 240)
MIDDLE = (np.array(SIZE) - 1) / 2


def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def picture() -> np.ndarray:
    return rng().integers(0, 256, (240, 320, 3), np.uint8)


def seen_at(homography: np.ndarray, point) -> np.ndarray:
    return cv2.perspectiveTransform(np.array([[point]], float), homography)[0, 0]


def test_every_query_has_a_right_place_in_the_smallest_map_and_maps_are_nested():
    wanted = [frozenset("ab"), frozenset("bc"), frozenset("d")]
    assert set(covering(wanted)) == {"b", "d"}
    queries = tuple(ScoredQuery(Path("q.jpg"), right, frozenset()) for right in wanted)
    dataset = Dataset(queries, Path(), tuple("abcd"))
    names = [*"abcd", *(f"generated/{number}" for number in range(6))]
    maps = [chosen(dataset, names, count) for count in (2, 3, 4, 7, 10)]
    assert [maps[0], maps[2], maps[-1]] == [{"b", "d"}, set("abcd"), set(names)]
    assert all(small < large for small, large in pairwise(maps))


def test_foreign_places_looking_down_are_mirrored_then_generated(tmp_path):
    for part in ("ref", "query"):
        (tmp_path / "site" / part).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "site" / part / f"{part}.png"), picture())
    frames = list(foreign("nadir", 18, tmp_path, [tmp_path / "site"]))
    assert [frame.name.partition("/")[0] for frame in frames] == [MIRRORED] * 16 + [GENERATED] * 2
    assert len({frame.name for frame in frames}) == 18
    mirrored, cut = picture()[:, ::-1], frames[0].image
    found = cv2.matchTemplate(mirrored, cut, cv2.TM_SQDIFF)
    assert found.min() < 0.01 * cut.size  # of squares of 0 to 65,025
    assert cut.shape[0] >= 120


def test_the_camera_moves_as_is_said():
    aside_px = np.array((40, 9))
    assert np.allclose(seen_at(view("nadir", "height", 2.0, SIZE, rng()), MIDDLE + 40), MIDDLE + 20)
    assert np.allclose(seen_at(view("nadir", "yaw", 180, SIZE, rng()), MIDDLE + aside_px), MIDDLE - aside_px)
    moved = seen_at(view("forward", "shift", 0.5, SIZE, rng()), MIDDLE) - MIDDLE
    assert np.allclose(np.abs(moved), (160, 0))
    looking_up = seen_at(view("nadir", "pitch", 33.0, SIZE, rng()), MIDDLE) - MIDDLE
    assert np.allclose(np.abs(looking_up), (0, 160))  # half of 66 degrees: half of the width
    aside = seen_at(view("forward", "yaw", 33.0, SIZE, rng()), MIDDLE) - MIDDLE
    assert np.allclose(np.abs(aside), (160, 0))
