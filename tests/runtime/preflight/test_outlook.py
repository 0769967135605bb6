"""What is said when a flight begins, and how few candidates its governor may have compared."""

from dataclasses import replace

import pytest
from example_costs import REGIONS

from edgevpr.core.config import load_config
from edgevpr.core.types import StageCost
from edgevpr.power.boards import load_board
from edgevpr.runtime.preflight import pick
from edgevpr.runtime.preflight.pick import limit_candidates, outlook
from edgevpr.runtime.recognise.opening import open_recogniser

COSTS = replace(REGIONS, match_per_place=StageCost(0.01, 0.01), candidates=42)


@pytest.fixture
def outlook_at(recording, monkeypatch):
    def found(rate_hz, costs=COSTS, **settings):
        monkeypatch.setattr(pick, "probe", lambda technique: costs)
        monkeypatch.setattr(pick, "on_board", lambda costs, *_: costs)
        config = load_config(None, {"map": str(recording / "cohog.gpkg"), "source.rate_hz": rate_hz, **settings})
        board = replace(load_board("this"), cores=4, cpu_share=0.5)
        recogniser = open_recogniser(config, board)
        # A flight over more places than candidates: this map has few.
        monkeypatch.setattr(type(recogniser.index), "__len__", lambda index: 1000)
        with recogniser.place_map:
            return outlook(recogniser, config)

    return found


def test_outlook_says_what_a_query_takes_and_finds(outlook_at):
    found = outlook_at(1.0)
    assert found.t_query_s == pytest.approx(0.52)
    assert "; recall@1 " in found.reason
    assert outlook_at(1.0, **{"match.candidates": 12}).t_query_s == pytest.approx(0.22)


def test_outlook_says_that_a_board_is_too_slow(outlook_at):
    hopeless = outlook_at(3.0, replace(COSTS, encode=StageCost(2.0, 2.0)))
    assert "0.41 Hz" in hopeless.reason


def test_trusted_candidates_accepted_nothing_wrong(recording, monkeypatch):
    config = load_config(None, {"map": str(recording / "cohog.gpkg")})
    recogniser = open_recogniser(config, load_board("this"))
    with recogniser.place_map:
        assert limit_candidates(recogniser.technique) == (20, 10)
        measured = pick.find_accuracy
        with monkeypatch.context() as changed:
            wrong = replace(measured("cohog", "forward", 10), accepted_elsewhere=1)
            changed.setattr(pick, "find_accuracy", lambda *asked: wrong if asked[-1] == 10 else measured(*asked))
            assert limit_candidates(recogniser.technique) == (20,)
    config = load_config(None, {"map": str(recording / "cohog.gpkg"), "match.matching": "thesis"})
    recogniser = open_recogniser(config, load_board("this"))
    with recogniser.place_map:
        assert limit_candidates(recogniser.technique) == (), "which was never measured so"
