"""The belief of a flight: what one query says, what a history adds, and what it must never add."""

import numpy as np
import pytest

from edgevpr.runtime.recognise.belief import Belief, Proposals
from edgevpr.runtime.recognise.hypotheses import MapScale
from edgevpr.runtime.recognise.place_filter import make_motion

PLACES = 100
SPACING_M = 20.0
ORDER_SCALE = MapScale(spacing=1.0, near=2.0, is_ordinal=True)
METRIC_SCALE = MapScale(spacing=SPACING_M, near=30.0)
STEP = make_motion(1.0, 3.0)  # within three places of the query before
CERTAIN = 0.999


def make_evidence(at, p, sd=0.5, heading_deg=np.nan, certain=False):
    """Evidence for positions `at` (K, 2), or (K,) in a map of places in order."""
    at = np.asarray(at, float)
    at = np.column_stack([at, np.zeros(len(at))]) if at.ndim == 1 else at
    return Proposals(
        probability=np.asarray(p, float),
        position=at,
        covariance=np.tile(sd**2 * np.eye(2), (len(at), 1, 1)),
        heading_deg=np.full(len(at), heading_deg),
        is_certain=np.full(len(at), certain),
    )


def make_place_evidence(place, rng, p=0.8, clutter=8):
    """What a query over a place says: it and its neighbours, and some places elsewhere."""
    near = round(place) + np.array([-1, 0, 1])
    near = near[(near >= 0) & (near < PLACES)]
    elsewhere = rng.choice(PLACES, clutter, replace=False)
    shares = np.exp(-abs(near - place))
    weak = rng.random(clutter)
    return make_evidence([*near, *elsewhere], [*(p * shares / shares.sum()), *(0.5 * (1 - p) * weak / weak.sum())])


def make_foreign_evidence(rng, clutter=10):
    """What a query over ground that is not in the map says: a little of everything."""
    p = rng.random(clutter) * rng.choice([0.05, 0.2])
    return make_evidence(rng.choice(PLACES, clutter, replace=False), p / clutter)


def fly(belief, places, rng, p=0.8):
    return [belief.update(make_place_evidence(place, rng, p), STEP, PLACES) for place in places]


@pytest.mark.parametrize("start", ["lost", "known"])
def test_update_gives_a_query_that_fits_no_history_its_own_confidence(start):
    rng, belief = np.random.default_rng(1), Belief(ORDER_SCALE)
    for n in range(10):
        belief.update(make_foreign_evidence(rng) if start == "lost" else make_place_evidence(10 + n, rng), STEP, PLACES)
    assert belief.update(make_evidence([80], [0.9]), STEP, PLACES).mass < 0.9


@pytest.mark.parametrize("speed", [0.5, 1, 2, -0.5, -1, -2])
def test_update_gains_confidence_from_consistent_queries(speed):
    places = (20 if speed > 0 else 80) + speed * np.arange(25)
    posteriors = fly(Belief(ORDER_SCALE), places, np.random.default_rng(2))
    assert max(each.mass for each in posteriors) >= CERTAIN
    assert all(each.mass > 0.99 for each in posteriors[12:])
    assert all(abs(each.position[0] - place) <= 2 for each, place in zip(posteriors, places, strict=True))
    assert posteriors[0].mass < 0.85


@pytest.mark.parametrize("p", [0.3, 0.6, 0.9])
def test_update_does_not_gain_confidence_in_a_hover_over_look_alikes(p):
    belief = Belief(ORDER_SCALE)
    assert max(belief.update(make_evidence([50], [p]), STEP, PLACES).mass for _ in range(300)) <= p + 1e-9


def test_update_replaces_the_previous_query_in_a_hover():
    belief = Belief(ORDER_SCALE)
    for p in (0.9, 0.2, 0.6):
        mass = belief.update(make_evidence([50], [p]), STEP, PLACES).mass
    assert 0.2 < mass < 0.65
    assert belief.update(make_evidence([50], [0.1]), STEP, PLACES).mass < 0.35


@pytest.mark.parametrize("p", [0.05, 0.2, 0.4])
@pytest.mark.parametrize("places", [100, 10_000])
def test_update_refuses_foreign_ground_that_resembles_the_map_slightly(p, places):
    belief = Belief(ORDER_SCALE)
    assert max(belief.update(make_evidence([10 + n], [p]), STEP, places).mass for n in range(80)) < CERTAIN


def test_update_predicts_the_place_that_a_certain_match_leads_to():
    belief = Belief(ORDER_SCALE)
    assert belief.update(make_evidence([50], [0.9], certain=True), STEP, PLACES).predicted == pytest.approx([0.0])
    near, far = belief.update(make_evidence([51, 80], [0.4, 0.4]), STEP, PLACES).predicted
    assert near > 0.85
    assert far == 0
    next_near, next_far = belief.update(make_evidence([52, 80], [0.4, 0.4]), STEP, PLACES).predicted
    assert next_near > 0.5
    assert next_far < 1e-6, "it may have jumped there, but nothing led there"


def test_update_predicts_nothing_from_uncertain_matches_alone():
    rng, belief = np.random.default_rng(1), Belief(ORDER_SCALE)
    posteriors = fly(belief, range(10, 40), rng)
    assert posteriors[-1].mass > CERTAIN
    assert max(posterior.predicted.max() for posterior in posteriors) < 1e-6


@pytest.mark.parametrize(("distance_m", "is_lost"), [(40.0, False), (120.0, True)])
def test_drop_off_map_makes_an_aircraft_lost_where_no_place_is_in_sight(distance_m, is_lost):
    belief = Belief(METRIC_SCALE)
    belief.update(make_evidence([[0.0, 0.0]], [0.99], sd=5.0), make_motion(1.0, 30.0), PLACES)
    belief.drop_off_map(np.array([[distance_m, 0.0], [0.0, 300.0]]), sight=100.0)
    lost = belief.update(None, make_motion(1.0, 30.0), PLACES).lost
    assert lost == pytest.approx(1.0) if is_lost else lost < 0.1


def fly_over(track_m, belief, odometry, p=0.8):
    """Fly over a track (N, 2) in metres; `odometry` makes what it reports from each true step."""
    posteriors = []
    for n, at in enumerate(track_m):
        said = odometry(at - track_m[n - 1]) if n else None
        beside = at + np.array([300.0 * np.cos(7 * n), 300.0 * np.sin(7 * n)])
        query = make_evidence([at, beside], [p, (1 - p) / 2], sd=4.0, heading_deg=350.0 if n % 2 else 10.0)
        posteriors.append(belief.update(query, make_motion(1.0, 40.0, said), PLACES))
    return posteriors


ODOMETRY_FAULTS = {
    "none": lambda step: None,
    "true": tuple,
    "twice": lambda step: tuple(2 * step),
    "half": lambda step: tuple(step / 2),
    "stopped": lambda step: (0.0, 0.0),
    "NaN": lambda step: (np.nan, np.nan),
    "infinite": lambda step: (np.inf, 0.0),
    "jumps": lambda step: (1e6, -1e6),
}


@pytest.mark.parametrize("odometry", ODOMETRY_FAULTS.values(), ids=ODOMETRY_FAULTS)
@pytest.mark.parametrize("speed_m", [5.0, 20.0, 40.0])
def test_update_gains_from_odometry_and_is_not_misled_by_wrong_odometry(odometry, speed_m):
    track_m = speed_m * np.column_stack([np.arange(30), 0.3 * np.arange(30)])
    posteriors = fly_over(track_m, Belief(METRIC_SCALE), odometry)
    off_m = [np.hypot(*(each.position - at)) for each, at in zip(posteriors, track_m, strict=True)]
    assert max(off_m) < SPACING_M
    assert posteriors[-1].mass > 0.99
    assert posteriors[-1].lost < 0.01


def test_update_trusts_no_place_if_all_look_the_same():
    belief = Belief(ORDER_SCALE)
    for _ in range(60):
        assert belief.update(make_evidence(np.arange(50), np.full(50, 0.98 / 50)), STEP, 50).mass < 0.6


def make_random_evidence(rng, count, scale):
    """Any evidence at all, a tenth of it spoilt."""
    p = rng.random(count) ** rng.choice([1, 30])
    at = rng.normal(size=(count, 2)) * scale + rng.choice([0, 1e6])
    root = rng.normal(size=(count, 2, 2)) * rng.choice([0, 1e-6, 1, 1e10])
    covariance = root @ root.transpose(0, 2, 1)
    for each in (p, at, covariance):
        if each.size and rng.random() < 0.1:
            each.flat[rng.integers(each.size)] = rng.choice([np.nan, np.inf, -np.inf, 1e300])
    heading_deg, is_certain = rng.choice([np.nan, 10], count), rng.random(count) < 0.2
    return Proposals(probability=p, position=at, covariance=covariance, heading_deg=heading_deg, is_certain=is_certain)


@pytest.mark.parametrize("ground", [ORDER_SCALE, METRIC_SCALE])
@pytest.mark.parametrize("places", [1, 1000, 10**6])
def test_update_accepts_any_numbers(ground, places):
    rng, belief = np.random.default_rng(places), Belief(ground)
    for _ in range(200):
        query = make_random_evidence(rng, int(rng.integers(0, 60)), rng.choice([0, 1, 100, 1e7]))
        velocity = rng.choice([0, 1, -3, np.nan, 1e9, np.inf], 2).tolist()
        elapsed_s = float(rng.choice([1, 1e-9, -1, np.nan, 1e6, 1e12]))
        posterior = belief.update(query, make_motion(elapsed_s, float(rng.choice([3, 1e5])), tuple(velocity)), places)
        assert np.isfinite([*posterior.probability, posterior.lost, posterior.mass]).all()
        assert not posterior.mass or np.linalg.eigvalsh(posterior.covariance)[0] > 0


@pytest.mark.parametrize(
    ("elapsed_s", "velocity", "by", "reach"),
    [
        (2.0, (3.0, -4.0), (6.0, -8.0), 60.0),
        (1.0, (60.0, 0.0), (60.0, 0.0), 30.0),  # twice the highest speed
        *((elapsed_s, (3.0, 4.0), None, 30.0) for elapsed_s in (None, -1.0, 0.0, float("nan"), -float("inf"))),
        *((2.0, velocity, None, 60.0) for velocity in (None, (np.nan, 1.0), (np.inf, 0.0), (61.0, 0.0))),
    ],
)
def test_limit_motion_ignores_implausible_times_and_velocities(elapsed_s, velocity, by, reach):
    motion = make_motion(elapsed_s, 30.0, velocity)
    assert (motion.displacement if by is None else tuple(motion.displacement), motion.reach) == (by, reach)
