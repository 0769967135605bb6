import numpy as np

from edgevpr.lab.training.words import kmeans


def clusters(rng, per_cluster=50):
    centres = rng.normal(0, 10, (6, 5)).astype(np.float32)
    points = (centres[:, None] + rng.normal(0, 0.1, (6, per_cluster, 5))).reshape(-1, 5).astype(np.float32)
    return centres, rng.permutation(points)


def cost(points, centres):
    return np.square(points[:, None] - centres).sum(axis=2).min(axis=1).mean()


def test_it_finds_clusters_that_are_apart():
    """With more centres than clusters, so that each cluster has one of the starts."""
    rng = np.random.default_rng(0)
    wanted, points = clusters(rng)
    *_, found = kmeans(points, 30, 20, rng)
    assert np.square(wanted[:, None] - found).sum(axis=2).min(axis=1).max() < 0.05
    assert cost(points, found) < 5 * 0.1**2


def test_a_round_is_the_textbooks():
    """Against a loop over points and centres."""
    points = np.random.default_rng(2).normal(size=(200, 3)).astype(np.float32)
    before, after = (np.array(c) for c in _two(kmeans(points, 7, 2, np.random.default_rng(3))))
    own = [min(range(7), key=lambda k: float(np.square(point - before[k]).sum())) for point in points]
    wanted = [
        np.mean([point for point, k in zip(points, own, strict=True) if k == number], axis=0) for number in range(7)
    ]
    np.testing.assert_allclose(after, wanted, atol=1e-5)


def _two(rounds):
    return [centres.copy() for centres in rounds]


def test_no_centre_is_left_without_points():
    rng = np.random.default_rng(4)
    points = np.repeat(rng.normal(size=(10, 4)).astype(np.float32), 30, axis=0)  # starts mostly coincide
    *_, found = kmeans(points, 10, 12, rng)
    assert cost(points, found) < 1e-6
