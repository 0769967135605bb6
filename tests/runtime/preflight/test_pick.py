"""The measured time of a query, the accuracy of a technique, and the numbers of candidates that are safe."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from edgevpr.core.config import load_config
from edgevpr.core.errors import EdgevprError
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.power.boards import load_board
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.preflight import pick
from edgevpr.runtime.recognise.opening import open_recogniser


@pytest.fixture
def recogniser(recording, clock):
    """A recogniser whose queries take the time of the clock."""
    board, config = load_board("this"), load_config(None, {"map": str(recording / "cohog.gpkg")})
    meter = QueryMeter(board, wall_clock=clock, cpu_clock=clock.clock.process_cpu_s)
    recogniser = open_recogniser(config, board, meter=meter)
    with recogniser.place_map:
        yield recogniser


def test_measure_query_excludes_the_warm_up_query(recogniser, clock):
    encode, seconds, shapes = recogniser.technique.encode, iter((6.0, 0.5)), []

    def work(image, mask):
        shapes.append(image.shape)
        clock.work(next(seconds), 2)
        return encode(image, mask)

    recogniser.technique.encode = work
    assert pick.measure_query(recogniser, (320, 240)) == 0.5
    assert shapes == [(240, 320)] * 2


def test_measure_query_reports_faults_and_refusals(recogniser):
    refused = SimpleNamespace(judge=lambda image: SimpleNamespace(reason=Reason(ReasonCode.NOT_MEMORABLE)))
    recogniser.encoder = replace(recogniser.encoder, gate=refused)
    assert pick.measure_query(recogniser, (320, 240)) is None
    recogniser.technique.encode = lambda *seen: 1 / 0
    with pytest.raises(EdgevprError, match="ZeroDivisionError"):
        pick.measure_query(recogniser, (320, 240))


def test_describe_accuracy_is_of_the_technique_and_form(recogniser):
    assert pick.describe_accuracy(recogniser.technique).startswith("recall@1 ")


def test_make_camera_setting_is_for_techniques_that_have_it():
    for camera, setting in (("nadir", {"camera": "nadir"}), ("forward", {"camera": "forward"}), (None, {})):
        assert pick.make_camera_setting("cohog", camera) == setting
        assert pick.make_camera_setting("hog", camera) == {}


def test_list_safe_candidates_lists_only_counts_without_wrong_matches(recording, monkeypatch):
    config = load_config(None, {"map": str(recording / "cohog.gpkg")})
    recogniser = open_recogniser(config, load_board("this"))
    with recogniser.place_map:
        assert pick.list_safe_candidates(recogniser.technique) == (20, 10)
        measured = pick.find_accuracy
        with monkeypatch.context() as changed:
            wrong = replace(measured("cohog", "forward", 10), accepted_elsewhere=1)
            changed.setattr(pick, "find_accuracy", lambda *asked: wrong if asked[-1] == 10 else measured(*asked))
            assert pick.list_safe_candidates(recogniser.technique) == (20,)
    config = load_config(None, {"map": str(recording / "cohog.gpkg"), "match.matching": "thesis"})
    recogniser = open_recogniser(config, load_board("this"))
    with recogniser.place_map:
        assert pick.list_safe_candidates(recogniser.technique) == (), "which was never measured so"
