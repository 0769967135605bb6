"""Agreement of landmarks that are given by hand: which ones match, which overlays are near, and what is claimed."""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from edgevpr.runtime.recognise.agreement import Agreement, Overlay, compare_near, compose_overlays, measure_agreement
from edgevpr.runtime.recognise.landmarks import Landmarks

IDENTITY = Overlay((0.0, 0.0), 0.0, 1.0)
UNSCALED = Overlay((0.0, 0.0), 0.0)


def make_circle(count, radius=0.3, middle=0.0):
    return middle + radius * np.exp(2j * np.pi * np.arange(count) / count)


ANGLE_DEG = 20.0  # of all landmarks on the ground


def make_landmarks(points, angle_deg=ANGLE_DEG, size=1.0, first=0):
    """Landmarks at complex points, each described otherwise: the same in all pictures by its number from `first` on."""
    points = np.asarray(points, complex)
    bits = np.random.default_rng(1).integers(0, 256, (100, 32), np.uint8)[first : first + len(points)]
    ones = np.ones(len(points), np.float32)
    xy = np.stack([points.real, points.imag], axis=1).astype(np.float32)
    return Landmarks(xy, angle_deg * ones, size * ones, bits)


def join(*each):
    return Landmarks(*(np.concatenate([getattr(one, name) for one in each]) for name in Landmarks.__slots__))


def make_pair(points, shift=0.0, rotation_deg=0.0, scale=1.0, first=0):
    """Landmarks of a place, and those of a query that lies on it so."""
    turn_scale = cmath.rect(scale, math.radians(rotation_deg))
    query = make_landmarks((np.asarray(points) - shift) / turn_scale, ANGLE_DEG - rotation_deg, 1 / scale, first)
    return query, make_landmarks(points, first=first)


@pytest.mark.parametrize(
    ("way", "expected", "is_near"),
    [
        ({"shift": 0.109}, IDENTITY, True),
        ({"shift": 0.1097}, IDENTITY, False),
        ({"rotation_deg": 24.9}, IDENTITY, True),
        ({"rotation_deg": -25.1}, IDENTITY, False),
        ({"scale": 1.34}, IDENTITY, True),
        ({"scale": 1.36}, IDENTITY, False),
        ({"scale": 1 / 1.34}, IDENTITY, True),
        ({"scale": 1 / 1.36}, IDENTITY, False),
        ({"scale": 1.89}, UNSCALED, True),
        ({"scale": 1.91}, UNSCALED, False),
        ({"scale": 1 / 1.89}, UNSCALED, True),
        ({"scale": 1 / 1.91}, UNSCALED, False),
        ({"scale": 0.41}, None, True),
        ({"scale": 0.39}, None, False),
        ({"scale": 2.49}, None, True),
        ({"scale": 2.51}, None, False),
        ({"shift": 0.3 - 0.2j, "rotation_deg": 200.0, "scale": 0.7}, Overlay((0.3, -0.2), 190.0, 0.7), True),
        ({"shift": 0.3 - 0.2j, "rotation_deg": 200.0, "scale": 0.7}, None, True),
    ],
)
def test_agreement_is_found_on_overlays_near_the_expected_one(way, expected, is_near):
    found = measure_agreement(*make_pair(make_circle(20), **way), expected)
    assert found.inliers == (20 if is_near else 0)
    if is_near:
        shift = complex(way.get("shift", 0.0))
        assert found.shift_share == pytest.approx((shift.real, shift.imag), abs=1e-6)
        assert found.rotation_deg % 360 == pytest.approx(way.get("rotation_deg", 0.0) % 360, abs=1e-4)
        assert found.scale == pytest.approx(way.get("scale", 1.0))


@pytest.mark.parametrize(
    ("at", "moved_by", "angle_deg", "size", "matches"),
    [
        (0.0, 0.109, 0.0, 1.0, True),
        (0.0, 0.110, 0.0, 1.0, False),
        (0.4, 0.33, 0.0, 1.0, True),  # 0.109 + 0.4 * (0.35 + 0.218)
        (0.4, 0.34, 0.0, 1.0, False),
        (0.0, 0.0, 29.9, 1.0, True),
        (0.0, 0.0, 30.1, 1.0, False),
        (0.0, 0.0, 0.0, 1.61, True),
        (0.0, 0.0, 0.0, 1.63, False),
        (0.0, 0.0, 0.0, 1 / 1.61, True),
        (0.0, 0.0, 0.0, 1 / 1.63, False),
    ],
)
@pytest.mark.parametrize("way", [{}, {"shift": 0.1, "rotation_deg": 90.0, "scale": 1.2}])
def test_landmark_matches_only_at_a_plausible_place_direction_and_size(way, at, moved_by, angle_deg, size, matches):
    query, place = make_pair(make_circle(10), **way)
    turn_scale = cmath.rect(way.get("scale", 1.0), math.radians(way.get("rotation_deg", 0.0)))
    more = make_landmarks([turn_scale * at + way.get("shift", 0.0) + moved_by], ANGLE_DEG + angle_deg, size, first=10)
    asked = make_landmarks([at], ANGLE_DEG - way.get("rotation_deg", 0.0), 1 / way.get("scale", 1.0), first=10)
    expected = Overlay((way.get("shift", 0.0), 0.0), way.get("rotation_deg", 0.0), way.get("scale", 1.0))
    assert measure_agreement(join(query, asked), join(place, more), expected).matched == 10 + matches


def test_landmark_matches_at_the_limit_of_its_size():
    most = np.float32(1.35 * 1.2)
    for sizes in ((most, 1.0), (1.0, most)):
        query, place = make_pair(make_circle(10))
        query.size[3], place.size[3] = sizes
        assert measure_agreement(query, place, IDENTITY).matched == 10


@pytest.mark.parametrize(("bits", "matches"), [(64, True), (65, False)])
def test_landmark_matches_with_up_to_a_quarter_of_different_bits(bits, matches):
    query, place = make_pair(make_circle(10))
    flipped = np.unpackbits(query.bits[3])
    flipped[:bits] ^= 1
    query.bits[3] = np.packbits(flipped)
    other_order = Landmarks(*(np.roll(getattr(place, name), 2, axis=0)[1:] for name in Landmarks.__slots__))
    assert measure_agreement(query, other_order).matched == 8 + matches


@pytest.mark.parametrize(("off", "inliers"), [(0.0150, 41), (0.0165, 40)])
def test_landmark_is_an_inlier_within_the_tolerance(off, inliers):
    query, place = make_pair([*make_circle(40), 0.0])
    place.points[40, 0] = off
    found = measure_agreement(query, place)
    assert (found.inliers, found.matched, found.possible) == (inliers, 41, 41)
    assert len(found.inlier_points[0]) == inliers


def test_agreement_is_implausible_if_all_inliers_are_outside_the_expected_overlays():
    query, place = make_pair(make_circle(12), shift=0.1097)
    place.points[::2, 0] -= 0.004  # half of them alone lie near it
    place.points[1::2, 0] += 0.004
    assert measure_agreement(query, place, IDENTITY).inliers == 0


@pytest.mark.parametrize(("count", "inliers"), [(2, 0), (3, 3)])
def test_measure_agreement_accepts_three_landmarks(count, inliers):
    found = measure_agreement(*make_pair(make_circle(count)))
    assert (found.inliers, found.matched, found.possible) == (inliers, inliers, count)


def test_landmarks_on_one_spot_do_not_agree():
    """What a damaged map may hold."""
    spot, points = make_landmarks([0.1] * 20), make_landmarks(make_circle(20, 0.2, middle=0.1))
    for expected in (None, IDENTITY):
        assert measure_agreement(spot, points, expected).inliers == 0
        assert measure_agreement(points, spot, expected).inliers == 0


@pytest.mark.parametrize(("middle", "off", "variance"), [(0.0, 0.0, 1.0), (0.0, 0.005, 2.0), (0.3, 0.005, 4.0)])
def test_variance_grows_with_the_residuals_and_the_distance_from_the_centre(middle, off, variance):
    """Twelve landmarks whose errors no rotation, scale or shift takes out: of 24 coordinates four are fitted."""
    query, place = make_pair(make_circle(12, middle=middle + 0.05), shift=0.05)
    place.points[:, 0] += off * (-1.0) ** np.arange(12)
    found = measure_agreement(query, place)
    assert found.shift_share == pytest.approx((0.05, 0.0), abs=1e-5)
    unit = off**2 if off else (10 / 6400) ** 2 * 40 / 12
    assert found.covariance_share2 == pytest.approx((variance * unit, 0.0, variance * unit), rel=1e-3)


SHIFTED = {"shift": 0.3}
ROTATED = {"rotation_deg": 90.0}
SCALED = {"scale": 1.5}


@pytest.mark.parametrize(
    ("as_expected", "otherwise", "way", "is_expected"),
    [
        (8, 14, SHIFTED, True),
        (7, 14, SHIFTED, False),
        (7, 10, SHIFTED, False),
        (7, 9, SHIFTED, True),
        (4, 12, ROTATED, False),
        (4, 12, SCALED, False),
    ],
)
def test_compare_near_returns_another_overlay_supported_by_many_landmarks(as_expected, otherwise, way, is_expected):
    pairs = make_pair(make_circle(as_expected, 0.1)), make_pair(make_circle(otherwise, 0.35), first=50, **way)
    found = compare_near(*(join(*each) for each in zip(*pairs, strict=True)), IDENTITY)
    assert found.is_expected is is_expected
    assert found.inliers == (as_expected if is_expected else otherwise)


def test_compare_near_ignores_displays_and_nearby_overlays():
    assert compare_near(*make_pair(make_circle(20)), Overlay((0.3, 0.0), 0.0, 1.0)).inliers == 0
    query, place = make_pair(make_circle(20), shift=0.05, rotation_deg=90.0)
    found = compare_near(replace(query, angle_deg=query.angle_deg + 90), place, Overlay((0.0, 0.0), 90.0, 1.0))
    assert (found.inliers, found.is_expected) == (0, True)


@pytest.mark.parametrize(
    ("shift", "rotation_deg", "scale", "is_unshifted"),
    [
        ((10 / 640, -10 / 640), 0.0, 1.0, True),
        ((0.0157, 0.0), 0.0, 1.0, False),
        ((0.0, 0.0), 2.0, 1.0, True),
        ((0.0, 0.0), 358.0, 0.971, True),
        ((0.0, 0.0), 2.1, 1.0, False),
        ((0.0, 0.0), 357.9, 1.0, False),
        ((0.0, 0.0), 0.0, 1.031, False),
        (None, None, None, False),
        ((0.0, 0.0), None, 1.0, False),
        ((0.0, 0.0), 0.0, None, False),
    ],
)
def test_agreement_is_unshifted_without_shift_rotation_or_scaling(shift, rotation_deg, scale, is_unshifted):
    shown = {"shift_share": shift, "rotation_deg": rotation_deg, "scale": scale}
    assert Agreement(inliers=20, matched=20, possible=20, **shown).is_unshifted is is_unshifted


def test_compose_overlays_leads_from_one_place_to_the_other():
    one, other = Overlay((0.1, 0.05), 30.0, 1.2), Overlay((-0.1, 0.2), 350.0, 0.8)
    both, point = compose_overlays(one, other), 0.3 - 0.1j
    on_one, on_other = (each.turn_scale * point + complex(*each.shift_share) for each in (one, other))
    assert both.turn_scale * on_one + complex(*both.shift_share) == pytest.approx(on_other, abs=1e-6)
    assert (both.rotation_deg, both.scale) == pytest.approx((320.0, 0.8 / 1.2))
    assert compose_overlays(one, replace(other, scale=None)).scale is None


def test_relative_pose_is_a_complex_step_and_a_logarithm():
    expected = 0.1 - 0.2j, math.log(1.5) + 1j * math.pi / 6
    assert Overlay((0.1, 0.2), 330.0, 1.5).relative_pose == pytest.approx(expected)
    assert Overlay((0.1, 0.2), 0.0).relative_pose[1] == 0
