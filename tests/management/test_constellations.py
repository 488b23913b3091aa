"""Constellations that agree under a shift and a turn, against what NumPy and SciPy have of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

from kalmark.arrays import Index
from kalmark.management import constellations as of

T = np.exp(0.7j), 30.0 - 4.0j


def places(z: of.Complex, parts: list[Index], tolerance: float = 0.1) -> of.Places:
    """Return places of which those of a part were seen together."""
    seen = [part[np.argsort(np.abs(z[part] - z[l]))][1:] for part in parts for l in part]
    by_x, first = np.argsort(z.real), np.cumsum([0, *(len(row) for row in seen)])
    given = np.zeros(len(z), dtype=np.bool_)
    return of.Places(z, z.real[by_x], by_x, first, np.concatenate(seen), given, tolerance, 1.0)


def at_random(count: int, seed: int = 0) -> of.Complex:
    return np.random.default_rng(seed).uniform(0.0, 10.0, (count, 2)).view(np.complex128).ravel()


def test_the_nearest_landmark_within_reach_is_found() -> None:
    z = at_random(60)
    look = places(z, [np.arange(60)])
    for place in at_random(40, seed=1):
        gaps = np.abs(z - place)
        for reach in (0.3, 3.0, 20.0):
            found, far = of.nearest(look, place, reach)
            assert found == (np.argmin(gaps) if gaps.min() <= reach else -1)
            assert far == pytest.approx(min(gaps.min(), reach))


def test_the_hull_has_the_corners_and_what_is_inside() -> None:
    z, some = at_random(40), np.arange(5, 30)
    xy = np.column_stack([z.real, z.imag])
    corners = of.hull(places(z, [np.arange(40)]), some)
    assert {*corners.tolist()} == {*z[some][ConvexHull(xy[some]).vertices].tolist()}
    others = np.setdiff1d(np.arange(40), some)
    inside = Delaunay(xy[some]).find_simplex(xy[others]) >= 0
    assert [of.is_inside(corners, place) for place in z[others]] == inside.tolist()
    line = places(np.arange(8) * (1.0 + 2.0j), [np.arange(8)])
    assert not of.is_inside(of.hull(line, np.arange(8)), 1.0 + 2.0j), "points on a line have no inside"


def test_three_pairs_are_extended_to_all_that_agree_and_the_others_are_missing() -> None:
    z, moved = at_random(20), T[0] * at_random(20) + T[1]
    middle = int(np.argmin(np.abs(moved - moved.mean())))
    both = np.concatenate([z, np.delete(moved, middle)])
    look = places(both, [np.arange(20), np.arange(20, 39)])
    partner = np.delete(np.arange(20), middle)
    hypothesis = np.column_stack([partner[:3], 20 + np.arange(3)])
    counts = of.count_agreeing(look, np.stack([hypothesis, [[0, 1], [2, 3], [4, 5]]]))
    assert counts[0] >= 1 + of.AROUND - 1, "all of those near but the missing one"
    assert counts[1] == 0, "landmarks that were seen together"
    found, pairs, missing = of.extended(look, hypothesis)
    np.testing.assert_allclose(found, T)
    assert {*map(tuple, pairs.tolist())} == {*zip(partner.tolist(), range(20, 39), strict=True)}
    assert missing == 1


def test_a_grid_agrees_with_itself_and_landmarks_at_random_do_not() -> None:
    grid = (np.arange(5)[:, None] + 1j * np.arange(5)).ravel() * 2.0
    share = {}
    for name, z in (("grid", grid), ("at random", at_random(25))):
        k, m, number = of.agreement_with_itself(places(z, [np.arange(25)]), np.arange(25))
        assert len(k) == len(m) <= of.MOVES <= number or len(k) == number
        share[name] = k.sum() / m.sum()
    assert share["grid"] > 0.9
    assert share["at random"] < 0.1
