"""The joint covariance of expectations, against the full product."""

from __future__ import annotations

import numpy as np

from kalmark.vision.joint_expectation import joint


def test_a_joint_expectation_is_the_covariance_of_all_with_the_state() -> None:
    """C = P H', S = H P H' with H of a head of two numbers and of one landmark of two each; only half of P is read."""
    rng, order = np.random.default_rng(0), np.array([4, 0, 5, 2, 1, 3])
    A = rng.normal(size=(6, 6))
    P, E_h, E_l = A @ A.T, rng.normal(size=(2, 3, 2)), rng.normal(size=(2, 3, 2))
    H = np.zeros((6, 6))
    for k, at in enumerate((2, 4)):
        H[3 * k : 3 * k + 3, :2], H[3 * k : 3 * k + 3, at : at + 2] = E_h[k], E_l[k]
    C, S = joint(np.tril(P), order, E_h, E_l, np.array([2, 4]), np.array([2, 2]))
    right = P[np.ix_(order, order)]
    np.testing.assert_allclose(C, right @ H.T, atol=1e-12)
    np.testing.assert_allclose(S, H @ right @ H.T, atol=1e-12)
