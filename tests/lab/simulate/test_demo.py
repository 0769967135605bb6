"""The demonstration on a small landscape: real processes, a real picture."""

from dataclasses import replace
from functools import partial

import cv2
import pytest

from edgevpr.lab.simulate import demo, generated
from edgevpr.lab.simulate.landscape import make_scene

pytestmark = [pytest.mark.process, pytest.mark.slow]


@pytest.fixture
def coarse_scene(monkeypatch):
    monkeypatch.setattr(demo, "make_scene", partial(make_scene, metres_per_pixel=0.5))
    for name in ("plan_mapping_flight", "plan_later_flight"):
        plan = getattr(generated, name)
        monkeypatch.setattr(generated, name, lambda seed, plan=plan: replace(plan(seed), poses=plan(seed).poses[:6]))


def test_run_demo_maps_flies_and_draws(coarse_scene, tmp_path):
    for left_over in ("map.gpkg", "map.gpkg-wal", "flight.jsonl", "demo.png"):
        (tmp_path / left_over).write_text('{"kind": "query"}\n')
    said = demo.run_demo(tmp_path)
    queries, _ = demo.read_queries(tmp_path / "flight.jsonl", tmp_path / "flight-1", tmp_path / "flight-2")
    assert len(queries) == 6
    picture = cv2.imread(str(tmp_path / "demo.png"))
    assert picture.shape == (1050, 2580, 3)
    assert picture.std() > 20
    assert "recall@1" in said
