"""What is said before a flight, and how few candidates its governor may have compared."""

from dataclasses import replace

import pytest
from example_costs import REGIONS

from edgevpr.core.config import load_config
from edgevpr.core.types import StageCost
from edgevpr.power.boards import load_board
from edgevpr.runtime.preflight import pick
from edgevpr.runtime.preflight.pick import list_safe_candidates, measure_flight
from edgevpr.runtime.recognise.opening import open_recogniser

COSTS = replace(REGIONS, match_per_place=StageCost(0.01, 0.01), candidates=42)


@pytest.fixture
def measure_at(recording, monkeypatch):
    def found(rate_hz, costs=COSTS, **settings):
        monkeypatch.setattr(pick, "measure_costs", lambda technique: costs)
        monkeypatch.setattr(pick, "scale_to_board", lambda costs, *_: costs)
        config = load_config(None, {"map": str(recording / "cohog.gpkg"), **settings})
        board = replace(load_board("this"), cores=4, cpu_share=0.5, rate_hz=rate_hz)
        recogniser = open_recogniser(config, board)
        # A flight over more places than candidates: this map has few.
        monkeypatch.setattr(type(recogniser.index), "__len__", lambda index: 1000)
        with recogniser.place_map:
            return measure_flight(recogniser)

    return found


def test_measure_flight_says_what_a_query_takes_and_finds(measure_at):
    t_query_s, cost = measure_at(1.0)
    assert t_query_s == pytest.approx(0.52)
    assert cost.startswith("recall@1 ")
    assert measure_at(1.0, **{"match.candidates": 12})[0] == pytest.approx(0.22)
    assert "0.41 Hz" in measure_at(3.0, replace(COSTS, encode=StageCost(2.0, 2.0)))[1]


def test_trusted_candidates_accepted_nothing_wrong(recording, monkeypatch):
    config = load_config(None, {"map": str(recording / "cohog.gpkg")})
    recogniser = open_recogniser(config, load_board("this"))
    with recogniser.place_map:
        assert list_safe_candidates(recogniser.technique) == (20, 10)
        measured = pick.find_accuracy
        with monkeypatch.context() as changed:
            wrong = replace(measured("cohog", "forward", 10), accepted_elsewhere=1)
            changed.setattr(pick, "find_accuracy", lambda *asked: wrong if asked[-1] == 10 else measured(*asked))
            assert list_safe_candidates(recogniser.technique) == (20,)
    config = load_config(None, {"map": str(recording / "cohog.gpkg"), "match.matching": "thesis"})
    recogniser = open_recogniser(config, load_board("this"))
    with recogniser.place_map:
        assert list_safe_candidates(recogniser.technique) == (), "which was never measured so"
