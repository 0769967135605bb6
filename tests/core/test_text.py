import pytest

from edgevpr.core.text import nines


@pytest.mark.parametrize(("probability", "said"), [(0.5, "0.5000"), (0.9999997, "0.99999970"), (1.0, "0." + 15 * "9")])
def test_a_probability_shows_as_many_nines_as_it_has(probability, said):
    assert nines(probability) == said
