"""The micro-benchmark: what it makes of its rounds, and that it runs, on however fast a machine."""

import pytest

from edgevpr.power import speed


def test_the_score_is_relative_to_the_reference_and_keeps_its_two_parts_apart(monkeypatch):
    monkeypatch.setattr(speed, "product_round", lambda: "product")
    monkeypatch.setattr(speed, "pass_round", lambda: "pass")
    rates = {"product": speed.REFERENCE_PRODUCTS_HZ / 16, "pass": speed.REFERENCE_PASSES_HZ / 4}
    monkeypatch.setattr(speed, "_rate", lambda work: rates[work])
    monkeypatch.setattr(speed, "_rate_together", lambda make, threads: 3 * rates[make()])
    found = speed.score()
    assert (found.products, found.passes) == pytest.approx((1 / 16, 1 / 4))
    assert (found.single, found.multi) == pytest.approx((1 / 8, 3 / 8))


def test_the_rate_is_that_of_the_quickest_round(monkeypatch):
    now_s, lengths_s = [0.0], [0.1, 0.3, 0.05, 0.2]
    monkeypatch.setattr(speed.time, "perf_counter", lambda: now_s[0])

    def work():
        now_s[0] += lengths_s[0]
        lengths_s.append(lengths_s.pop(0))

    assert speed._rate(work) == pytest.approx(1 / 0.05)


def test_the_real_benchmark_runs(monkeypatch):
    monkeypatch.setattr(speed, "_LEAST_S", 0.01)
    found = speed.score()
    assert all(value > 0 for value in (found.single, found.multi, found.products, found.passes))
    assert found.single == pytest.approx((found.products * found.passes) ** 0.5)
